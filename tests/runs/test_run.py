"""Runs from start to end: interrupted, resumed, repeated, on both backends."""

from __future__ import annotations

import errno
import os
import resource
import shutil

import pytest

from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.metrics import MetricsTable
from gdrl_torchrl.files.run_table import state_of
from gdrl_torchrl.pictures import figures
from gdrl_torchrl.runs import report, run
from gdrl_torchrl.runs.monitor import COLUMNS
from gdrl_torchrl.runs.run import run_experiment
from tests.marks import full_but, grainbow_is_quick

PICTURES = ("draw_learning_curve", "draw_trajectories", "write_video")
pytestmark = pytest.mark.usefixtures("without_figures")


def test_an_interrupted_run_ends_where_an_uninterrupted_one_does(
    tiny_of_each, tmp_path, rows_of, evaluation_of
):
    whole = run_experiment(
        tiny_of_each("budget.agent_steps=240", f"runs_dir={tmp_path / 'a'}")
    )
    for steps in (80, 160, 240):
        pieces = run_experiment(
            tiny_of_each(f"budget.agent_steps={steps}", f"runs_dir={tmp_path / 'b'}")
        )
    assert rows_of(pieces) == rows_of(whole)
    mine, other = evaluation_of(pieces), evaluation_of(whole)
    assert mine.pop("wall_s") > 0.0
    assert other.pop("wall_s") > 0.0
    assert mine == other
    rows = rows_of(whole)
    assert [row["agent_steps"] for row in rows] == ["40", "80", "120", "160", "200", "240"]
    assert int(rows[-1]["evaluations"]) >= 2, "evaluations must be part of what is resumed"
    assert int(rows[-1]["population_steps"]) > 0


@grainbow_is_quick
def test_a_killed_run_goes_on_from_its_last_checkpoint(
    tiny_of_each, tmp_path, monkeypatch, rows_of, evaluation_of, whole_of
):
    every = "checkpoint.interval_s=0"
    whole = whole_of(tiny_of_each())
    append = MetricsTable.append

    def append_and_die(self, row):
        append(self, row)
        if row["agent_steps"] == 80:
            raise KeyboardInterrupt

    config = tiny_of_each(every)
    with monkeypatch.context() as patch:
        patch.setattr(MetricsTable, "append", append_and_die)
        with pytest.raises(KeyboardInterrupt):
            run_experiment(config)
    # The row of step 80 was written and cut short, its checkpoint was not saved.
    (metrics,) = tmp_path.rglob("metrics.csv")
    metrics.write_bytes(metrics.read_bytes()[:-9])
    resumed = run_experiment(config)
    assert rows_of(resumed) == rows_of(whole)
    assert evaluation_of(resumed)["params_sha256"] == evaluation_of(whole)["params_sha256"]


def test_a_full_disk_is_named_and_the_run_goes_on_when_there_is_room(
    tiny, tmp_path, monkeypatch, rows_of, evaluation_of, whole_of
):
    whole = whole_of(tiny())
    append = MetricsTable.append

    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    def append_until_full(self, row):
        if row["agent_steps"] == 80:
            full()
        append(self, row)

    config = tiny("checkpoint.interval_s=0")
    with monkeypatch.context() as patch:
        patch.setattr(MetricsTable, "append", append_until_full)
        patch.setattr(run.RunDirectory, "write_json", write_unless_failed(full))
        with pytest.raises(RunDirectoryError, match="No space left") as stop:
            run_experiment(config)
    assert str(tmp_path) in str(stop.value)
    resumed = run_experiment(config)
    assert rows_of(resumed) == rows_of(whole)
    assert evaluation_of(resumed)["params_sha256"] == evaluation_of(whole)["params_sha256"]


def write_unless_failed(full):
    write = run.RunDirectory.write_json

    def write_json(self, name, content):
        return full() if name == "FAILED" else write(self, name, content)

    return write_json


@grainbow_is_quick
def test_results_do_not_depend_on_threads_but_on_the_seed(
    tiny_of_each, tmp_path, rows_of, evaluation_of
):
    # 72 worlds of the evaluation: enough for two threads to share them.
    wide = ("evolution.num_trials=24", "budget.agent_steps=80")
    one = run_experiment(tiny_of_each(*wide, f"runs_dir={tmp_path / 'a'}"))
    two = run_experiment(
        tiny_of_each(*wide, f"runs_dir={tmp_path / 'b'}", "simulation.num_threads=2")
    )
    assert rows_of(one) == rows_of(two)
    assert int(rows_of(one)[-1]["evaluations"]) > 0
    assert evaluation_of(one)["params_sha256"] == evaluation_of(two)["params_sha256"]
    other = run_experiment(tiny_of_each(*wide, "seed=1", f"runs_dir={tmp_path / 'a'}"))
    assert other.parent == one.parent
    assert evaluation_of(one)["params_sha256"] != evaluation_of(other)["params_sha256"]


def test_a_finished_run_is_not_trained_again(tiny, monkeypatch, rows_of):
    path = run_experiment(tiny())
    written = {p: p.stat().st_mtime_ns for p in path.rglob("*") if p.is_file()}

    def no_training(config):
        raise AssertionError("trained again")

    monkeypatch.setattr(run, "build_training", no_training)
    assert run_experiment(tiny()) == path
    assert run_experiment(tiny("budget.agent_steps=40")) == path, "a smaller budget"
    changed = {
        p.name
        for p, time in written.items()
        if not p.exists() or p.stat().st_mtime_ns != time
    }
    assert changed <= {".lock"}


@pytest.mark.parametrize("part", full_but(["draw_trajectories"], PICTURES))
def test_pictures_that_cannot_be_made_do_not_fail_a_run(part, tiny, monkeypatch, caplog):
    def broken(*arguments, **options):
        raise RuntimeError("there is no ffmpeg here")

    monkeypatch.setattr(report if part == "write_video" else figures, part, broken)
    # A film takes many seconds: only the one that fails is asked for.
    films = int(part == "write_video")
    path = run_experiment(tiny(f"logger.video_episodes={films}"))
    assert state_of(path) == "done"
    (said,) = [line for line in caplog.messages if "ffmpeg" in line]
    assert "the run is complete without it" in said


@pytest.mark.parametrize("asked", [True, False])
def test_figures_are_drawn_only_if_asked_for(asked, tiny, monkeypatch):
    drawn = []
    for name in ("draw_learning_curve", "draw_trajectories"):
        monkeypatch.setattr(figures, name, drawn.append)
    path = run_experiment(tiny(f"logger.figures={asked}"))
    assert drawn == [path, path] * asked
    assert state_of(path) == "done"


def no_more_files():
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, most))


def no_large_files():
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, most))


@pytest.mark.parametrize(
    ("happens", "number", "advice"),
    [
        (no_large_files, errno.EFBIG, "ulimit -f"),
        (no_more_files, errno.EMFILE, "ulimit -n"),
        ("removed", errno.ENOENT, "was something removed"),
        (None, errno.ESTALE, "a disk taken away"),
        (None, errno.ENOMEM, "Cannot allocate memory"),
    ],
    ids=["large", "files", "removed", "stale", "memory"],
)
def test_errors_of_the_system_are_named(
    happens, number, advice, tiny, tmp_path, monkeypatch
):
    """Real ones where they can be had."""
    append = MetricsTable.append

    def append_and_break(self, row):
        if happens is None:
            raise OSError(number, os.strerror(number))
        append(self, row)
        if happens == "removed":
            shutil.rmtree(self.path.parent)
        else:
            happens()

    limits = {
        r: resource.getrlimit(r) for r in (resource.RLIMIT_NOFILE, resource.RLIMIT_FSIZE)
    }
    monkeypatch.setattr(MetricsTable, "append", append_and_break)
    try:
        with pytest.raises(RunDirectoryError, match=advice) as refused:
            run_experiment(tiny("checkpoint.interval_s=0"))
    finally:
        for which, limit in limits.items():
            resource.setrlimit(which, limit)
    assert str(tmp_path) in str(refused.value)
    assert os.strerror(number) in str(refused.value)


def test_other_held_out_worlds_evaluate_again_without_training(
    tiny, rows_of, evaluation_of
):
    path = run_experiment(tiny())
    rows, digest = rows_of(path), evaluation_of(path)["params_sha256"]
    assert run_experiment(tiny("evaluation.episodes=5")) == path
    assert rows_of(path) == rows
    assert evaluation_of(path)["episodes"] == 5
    assert evaluation_of(path)["params_sha256"] == digest


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task.step_limit=0", "step_limit=0"),
        ("task.backend=gpu", r"task\.backend='gpu'"),
        ("task.actions=discrete", r"'discrete' must be 'continuous' with .*'ppo'"),
    ],
)
def test_a_task_that_does_not_work_leaves_no_directory(override, message, tiny, tmp_path):
    with pytest.raises(ValueError, match=message):
        run_experiment(tiny(override))
    assert not list(tmp_path.iterdir())


def test_rainbow_refuses_a_task_with_continuous_actions(tiny_rainbow, tmp_path):
    with pytest.raises(ValueError, match=r"must be 'discrete' with .*'rainbow'"):
        run_experiment(tiny_rainbow("task.actions=continuous"))
    assert not list(tmp_path.iterdir())


def test_a_run_without_evolution_has_no_population_steps(tiny, rows_of, evaluation_of):
    path = run_experiment(tiny("experiment=ppo_water", "evolution=none"))
    record = evaluation_of(path)
    assert record["algorithm"] == "ppo"
    assert (record["population_steps"], record["evaluations"], record["switches"]) == (
        0,
    ) * 3
    assert record["agent_steps"] == record["total_steps"] == 120
    assert all(row["population_steps"] == "0" for row in rows_of(path))
    assert rows_of(path)[-1]["success_rate"] != ""


def test_the_dm_control_backend_trains_and_evaluates_a_population_of_three(
    tiny, rows_of, evaluation_of
):
    options = (
        "task.backend=dm_control",
        "algorithm.frames_per_batch=500",
        "algorithm.minibatch_size=250",
        "evolution.period_episodes=60",
    )
    path = run_experiment(tiny(*options, "budget.agent_steps=1000"))
    rows, record = rows_of(path), evaluation_of(path)
    assert record["agent_steps"] == 1000
    assert record["evaluations"] >= 1
    assert record["population_steps"] >= 3 * 2
    assert rows[-1]["success_rate"] != ""
    assert set(rows[0]) > set(COLUMNS) - {"wall_s"}


@pytest.mark.full
def test_a_run_on_the_dm_control_backend_goes_on(tiny, rows_of):
    for steps in (80, 160):
        path = run_experiment(
            tiny("task.backend=dm_control", f"budget.agent_steps={steps}")
        )
    rows = rows_of(path)
    assert [row["agent_steps"] for row in rows] == ["40", "80", "120", "160"]
    assert int(rows[-1]["episodes"]) > int(rows[1]["episodes"]) > 0


@pytest.mark.full
def test_runs_that_share_a_process_do_not_share_anything_else(
    tiny_of_each, tmp_path, rows_of, evaluation_of
):
    # TorchRL's trainers keep counters on their class, which two runs of one have.
    results = []
    for folder, seeds in (("a", (0, 1)), ("b", (1, 0))):
        runs = f"runs_dir={tmp_path / folder}"
        paths = {seed: run_experiment(tiny_of_each(runs, f"seed={seed}")) for seed in seeds}
        results.append(
            [
                (rows_of(paths[seed]), evaluation_of(paths[seed])["params_sha256"])
                for seed in (0, 1)
            ]
        )
    assert results[0] == results[1]
    assert results[0][0] != results[0][1]
