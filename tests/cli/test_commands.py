"""The commands as a user runs them: few, since each takes seconds to import."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sysconfig
import time
from pathlib import Path

import pytest

from gdrl_torchrl.cli.evaluate import evaluate_run

SCRIPTS = Path(sysconfig.get_path("scripts"))
OVERRIDES = (
    "seed=5",
    "task.sea=calm",
    "task.step_limit=12",
    "algorithm.num_worlds=4",
    "algorithm.frames_per_batch=40",
    "algorithm.minibatch_size=20",
    "algorithm.num_epochs=1",
    "network.actor_cells=[8]",
    "network.critic_cells=[8]",
    "evolution.num_children=2",
    "evolution.num_trials=2",
    "evolution.period_episodes=100",
    "evaluation.episodes=6",
    "evaluation.num_worlds=6",
    "budget.agent_steps=3200",
    "logger.video_episodes=1",
)
EVALUATION_KEYS = [
    "task",
    "algorithm",
    "seed",
    "episodes",
    "success_rate",
    "collision_rate",
    "timeout_rate",
    "diverged_rate",
    "spl",
    "return_mean",
    "steps_mean",
    "time_s_mean",
    "speed_m_s_mean",
    "agent_steps",
    "population_steps",
    "total_steps",
    "wall_s",
    "evaluations",
    "switches",
    "params_sha256",
]
FILES = [
    "config.json",
    "provenance.json",
    "metrics.csv",
    "evaluation.json",
    "DONE",
    "figures/learning_curve.png",
    "figures/trajectories.png",
    "videos/episodes.mp4",
    "final/policy.safetensors",
    "final/contract.json",
]


def start(name, *arguments, cwd):
    return subprocess.Popen(
        [SCRIPTS / name, *arguments],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )


def finish(process, *, timeout=180):
    try:
        out, err = process.communicate(timeout=timeout)
    finally:
        process.kill()
    return process.returncode, out, err


def run(name, *arguments, cwd):
    return finish(start(name, *arguments, cwd=cwd))


def rows_of(metrics):
    with open(metrics, newline="") as file:
        return list(csv.DictReader(file))


def wait_for_rows(folder, count, *, seconds=120):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        for metrics in folder.rglob("metrics.csv"):
            if len(rows_of(metrics)) >= count:
                return metrics.parent
        time.sleep(0.05)
    raise AssertionError("training did not begin")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cli")


@pytest.fixture(scope="module")
def interrupted(folder):
    """A run that Ctrl-C stopped: its directory, exit status, both outputs, its rows."""
    process = start("gdrl-train", *OVERRIDES, cwd=folder)
    try:
        path = wait_for_rows(folder, 3)
    except BaseException:
        process.kill()
        raise
    process.send_signal(signal.SIGINT)
    code, out, err = finish(process)
    return path, code, out, err, rows_of(path / "metrics.csv")


@pytest.fixture(scope="module")
def finished(interrupted, folder):
    """The same command again: exit status and both outputs."""
    return run("gdrl-train", *OVERRIDES, cwd=folder)


@pytest.fixture(scope="module")
def path(interrupted, finished):
    assert finished[0] == 0, finished[2]
    return interrupted[0]


def test_ctrl_c_saves_and_says_how_to_go_on(interrupted):
    path, code, out, err, rows = interrupted
    assert code == 128 + signal.SIGINT
    assert "the same command goes on" in err
    assert path.name in err
    assert "Traceback" not in err
    assert out == ""
    assert list((path / "checkpoints").iterdir())
    assert rows[-1]["agent_steps"] != "3200"


def test_the_same_command_goes_on_to_the_end(interrupted, finished, path):
    _, _, _, _, before = interrupted
    rows = rows_of(path / "metrics.csv")
    assert rows[: len(before)] == before
    assert [int(row["agent_steps"]) for row in rows] == list(range(40, 3201, 40))
    clock = [float(row["wall_s"]) for row in rows]
    assert clock == sorted(clock)


def test_the_last_line_is_the_run_directory(finished, path, folder):
    last = finished[1].splitlines()[-1]
    assert (folder / last).resolve() == path.resolve()
    assert (folder / "runs").resolve() in path.resolve().parents


def test_a_run_directory_holds_what_is_promised(path):
    for name in FILES:
        assert (path / name).stat().st_size > 0, name
    assert list(path.rglob("events.out.tfevents*"))
    assert not list(path.rglob("*.partial*"))
    assert not list(path.parents[4].glob("MUJOCO_LOG.TXT"))


def test_the_evaluation_has_exactly_the_promised_keys(path):
    record = json.loads((path / "evaluation.json").read_text())
    assert list(record) == EVALUATION_KEYS
    assert (record["task"], record["algorithm"], record["seed"]) == ("water", "gppo", 5)
    assert record["episodes"] == 6
    assert record["agent_steps"] == 3200
    assert record["total_steps"] == 3200 + record["population_steps"]
    assert record["evaluations"] >= record["switches"] >= 0
    assert record["evaluations"] >= 1
    rates = [record[f"{name}_rate"] for name in ("success", "collision", "timeout")]
    assert sum(rates) + record["diverged_rate"] == pytest.approx(1.0)
    assert record["time_s_mean"] == pytest.approx(0.25 * record["steps_mean"])


def test_a_finished_run_returns_at_once(finished, path, folder):
    before = {p: p.stat().st_mtime_ns for p in path.rglob("*") if p.is_file()}
    code, out, err = run("gdrl-train", *OVERRIDES, cwd=folder)
    assert code == 0
    assert out.splitlines()[-1] == finished[1].splitlines()[-1]
    assert "already complete" in err
    after = {p: p.stat().st_mtime_ns for p in path.rglob("*") if p.is_file()}
    assert {p.name for p in before if before[p] != after.get(p)} <= {".lock"}


def test_a_run_is_evaluated_again_under_other_settings(path, folder):
    code, out, err = run(
        "gdrl-evaluate", f"run={path}", "episodes=4", "task.sea=rough", cwd=folder
    )
    assert code == 0, err
    record = json.loads(out.splitlines()[-1])
    assert record["overrides"] == ["task.sea=rough"]
    assert record["episodes"] == 4
    assert set(record) >= {"success_rate", "timeout_rate", "spl", "return_mean"}
    saved = json.loads((path / "evaluation.json").read_text())
    assert record["params_sha256"] == saved["params_sha256"]
    assert saved["episodes"] == 6, "the run's own evaluation stays"


def test_without_overrides_it_repeats_the_runs_own_evaluation(path):
    again = evaluate_run([f"run={path}"])
    saved = json.loads((path / "evaluation.json").read_text())
    for name in EVALUATION_KEYS[4:13]:
        assert again[name] == pytest.approx(saved[name], abs=1e-9), name
    assert again["overrides"] == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "usage"),
        (["episodes=3"], "usage"),
        (["run={path}", "fuel=1"], "fuel=1"),
        (["run={path}", "episodes"], "episodes"),
        (["run={path}", "episodes=0"], "episodes=0"),
        (["run={path}", "episodes=-2"], "episodes=-2"),
        (["run={path}", "episodes=many"], "episodes='many'"),
        (["run={path}", "seed=-1"], "seed=-1"),
        (["run={path}", "seed=1.5"], "seed='1.5'"),
        (["run={path}", "task.sea=stormy"], "sea='stormy'"),
        (["run={path}", "task.fuel=1"], "fuel"),
        (["run={path}", "task.step_limit=many"], "step_limit"),
        (["run={path}", "task.actions=discrete"], "actions"),
        (["run={path}", "task.extra_observations=[roll]"], "extra_observations"),
        (["run=elsewhere"], "run=elsewhere"),
    ],
)
def test_bad_arguments_of_an_evaluation_are_named(arguments, said, path):
    with pytest.raises(ValueError, match=r".") as refused:
        evaluate_run([argument.format(path=path) for argument in arguments])
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("command", "arguments", "said"),
    [
        ("gdrl-train", ["algorithm.fuel=1"], "algorithm.fuel"),
        ("gdrl-train", ["task.step_limit=0"], "step_limit=0"),
        ("gdrl-evaluate", ["run=elsewhere"], "run=elsewhere"),
    ],
)
def test_mistakes_end_a_command_with_one_readable_error(command, arguments, said, tmp_path):
    code, out, err = run(command, *arguments, cwd=tmp_path)
    assert code not in (0, None)
    assert said in err
    assert "Traceback" not in err
    assert out == ""
    assert not list(tmp_path.iterdir()), "nothing may be written"
