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
from gdrl_torchrl.files.run_table import find_runs
from tests.small import tiny_options

SCRIPTS = Path(sysconfig.get_path("scripts"))
OVERRIDES = tiny_options(
    "gppo_water",
    [
        "seed=5",
        "evolution.period_episodes=100",
        "evaluation.episodes=6",
        "evaluation.num_worlds=6",
        "budget.agent_steps=3200",
        "logger.tensorboard=true",
        "logger.video_episodes=1",
    ],
)
EVALUATION_KEYS = [
    "task",
    "algorithm",
    "seed",
    "episodes",
    "success_rate",
    "success_rate_sampled",
    "collision_rate",
    "timeout_rate",
    "capsized_rate",
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
    "overrides.json",
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
        for metrics in (run / "metrics.csv" for run in find_runs(folder)):
            if metrics.exists() and len(rows_of(metrics)) >= count:
                return metrics.parent
        time.sleep(0.05)
    raise AssertionError("training did not begin")


def check_what_ctrl_c_said(path, code, out, err):
    assert code == 75  # EX_TEMPFAIL: saved, try again
    assert "the same command goes on" in err
    assert path.name in err
    assert "Traceback" not in err
    assert out == ""
    assert list((path / "checkpoints").iterdir())
    assert not (path / "DONE").exists()


def check_that_it_went_on(path, rows_before):
    rows = rows_of(path / "metrics.csv")
    assert rows[: len(rows_before)] == rows_before
    assert [int(row["agent_steps"]) for row in rows] == list(range(40, 3201, 40))
    clock = [float(row["wall_s"]) for row in rows]
    assert clock == sorted(clock)


def check_the_directory(path):
    for name in FILES:
        assert (path / name).stat().st_size > 0, name
    assert list(path.rglob("events.out.tfevents*"))
    assert not list(path.rglob("*.partial*"))


def check_what_was_given_is_kept(path):
    kept = json.loads((path / "overrides.json").read_text())
    assert kept == {"overrides": OVERRIDES}


def check_the_evaluation(path):
    record = json.loads((path / "evaluation.json").read_text())
    assert list(record) == EVALUATION_KEYS
    assert (record["task"], record["algorithm"], record["seed"]) == ("water", "gppo", 5)
    assert record["episodes"] == 6
    assert record["agent_steps"] == 3200
    assert record["total_steps"] == 3200 + record["population_steps"]
    assert record["evaluations"] >= record["switches"] >= 0
    assert record["evaluations"] >= 1
    names = ("success", "collision", "timeout", "capsized", "diverged")
    assert sum(record[f"{name}_rate"] for name in names) == pytest.approx(1.0)
    assert record["time_s_mean"] == pytest.approx(0.25 * record["steps_mean"])


def check_an_evaluation_under_other_settings(path, folder):
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
    again = evaluate_run([f"run={path}"])
    assert again["overrides"] == []
    for name in EVALUATION_KEYS[4:13]:
        assert again[name] == pytest.approx(saved[name], abs=1e-9), name


def check_that_the_command_only_returns_it(last_line, path, folder):
    before = {p: p.stat().st_mtime_ns for p in path.rglob("*") if p.is_file()}
    code, out, err = run("gdrl-train", *OVERRIDES, cwd=folder)
    assert code == 0, err
    assert out.splitlines()[-1] == last_line
    assert "already complete" in err
    after = {p: p.stat().st_mtime_ns for p in path.rglob("*") if p.is_file()}
    assert {p.name for p in before if before[p] != after.get(p)} <= {".lock"}


@pytest.mark.full
def test_a_run_is_interrupted_goes_on_is_evaluated_and_is_returned(tmp_path):
    # One test, for the commands take long to start and xdist may part a file.
    process = start("gdrl-train", *OVERRIDES, cwd=tmp_path)
    try:
        path = wait_for_rows(tmp_path, 3)
        process.send_signal(signal.SIGINT)
        check_what_ctrl_c_said(path, *finish(process))
    finally:
        process.kill()
    rows = rows_of(path / "metrics.csv")

    code, out, err = run("gdrl-train", *OVERRIDES, cwd=tmp_path)
    assert code == 0, err
    last_line = out.splitlines()[-1]
    assert (tmp_path / last_line).resolve() == path.resolve()
    assert (tmp_path / "runs").resolve() in path.resolve().parents
    assert [entry.name for entry in tmp_path.iterdir()] == ["runs"]
    check_that_it_went_on(path, rows)
    check_the_directory(path)
    check_what_was_given_is_kept(path)
    check_the_evaluation(path)
    check_an_evaluation_under_other_settings(path, tmp_path)
    check_that_the_command_only_returns_it(last_line, path, tmp_path)
