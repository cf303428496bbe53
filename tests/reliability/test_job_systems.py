"""What ends processes from outside: time limits of job systems, closed terminals."""

from __future__ import annotations

import csv
import os
import pty
import signal
import subprocess
import sys
import time

import pytest

from gdrl_torchrl.files.run_table import find_runs, run_row, state_of

TRAIN = [sys.executable, "-m", "gdrl_torchrl.cli.train"]
NEVER_BY_ITSELF = "checkpoint.interval_s=100000"


def rows_of(run):
    with (run / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def wait_for_rows(folder, count, *, seconds=300):
    """The run below a folder, once it has so many rows."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        for run in find_runs(folder):
            if (run / "metrics.csv").exists() and len(rows_of(run)) >= count:
                return run
        time.sleep(0.1)
    raise AssertionError("training did not begin")


@pytest.mark.full
@pytest.mark.parametrize(
    ("signal_name", "requeues"), [("USR2", 0), ("TERM", 0), ("USR2", 1)]
)
def test_a_time_limit_of_submitit_saves_and_the_job_goes_on(
    signal_name, requeues, tmp_path, options_of
):
    """Its local jobs get the signal after 30 of 60 seconds, and save at no other time."""
    options = [o for o in options_of("grainbow_indoor") if not o.startswith("budget.")]
    command = [
        *(*TRAIN, "-m", *options, "seed=0", f"runs_dir={tmp_path}", NEVER_BY_ITSELF),
        *("budget.agent_steps=null", "logger.tensorboard=false"),
        *("hydra/launcher=submitit_local", "hydra.launcher.timeout_min=1"),
        f"+hydra.launcher.max_num_timeout={requeues}",
    ]
    environment = os.environ | {"SUBMITIT_PREEMPT_SIGNAL": signal_name}

    def launch(seconds):
        return subprocess.run(
            [*command, f"budget.wall_s={seconds}"],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )

    stopped = launch(10_000)
    logs = "".join(log.read_text() for log in tmp_path.rglob("*_log.err"))
    assert stopped.returncode != 0
    assert f"stopped by SIG{signal_name} and saved" in stopped.stderr
    assert "not requeued" in stopped.stderr
    assert logs.count("finishing this iteration, then saving") == 1 + requeues
    (run,) = find_runs(tmp_path)
    assert state_of(run) == "stopped"
    assert len(list((run / "checkpoints").iterdir())) == 1 + requeues
    trained = float(rows_of(run)[-1]["wall_s"])
    finished = launch(trained + 1.0)
    assert finished.returncode == 0, finished.stderr
    assert run_row(run)["state"] == "done"
    steps = [int(row["agent_steps"]) for row in rows_of(run)]
    assert steps == list(range(40, 40 * len(steps) + 1, 40)), "every step was made once"


@pytest.mark.full
def test_a_closed_terminal_saves_a_run(tmp_path, options_of):
    """A real terminal, whose other side is closed as a lost connection closes it."""
    options = [o for o in options_of("grainbow_indoor") if not o.startswith("budget.")]
    command = [*TRAIN, *options, f"runs_dir={tmp_path}", NEVER_BY_ITSELF]
    process_id, terminal = pty.fork()
    if process_id == 0:
        os.execv(command[0], [*command, "budget.agent_steps=100000000"])
    try:
        os.set_blocking(terminal, False)
        run = wait_for_rows(tmp_path, 3)
        os.close(terminal)
        deadline = time.monotonic() + 120
        ended, status = 0, 0
        while not ended and time.monotonic() < deadline:
            ended, status = os.waitpid(process_id, os.WNOHANG)
            time.sleep(0.1)
        assert ended, "it did not end"
        assert os.waitstatus_to_exitcode(status) == 75
    finally:
        if not ended:
            os.kill(process_id, signal.SIGKILL)
            os.waitpid(process_id, 0)
    assert state_of(run) == "stopped"
    assert len(list((run / "checkpoints").iterdir())) == 1


@pytest.mark.full
def test_jobs_that_change_their_folder_have_their_runs_where_they_say(tmp_path):
    done = subprocess.run(
        [
            *(*TRAIN, "-m", "experiment=ppo_water", "toy=true", "seed=0"),
            *("hydra.job.chdir=true", "hydra.sweep.subdir=jobs/${hydra.job.num}"),
            *("budget.total_steps=1000", "evaluation.episodes=2", "runs_dir=our_runs"),
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    run = tmp_path / done.stdout.split()[-1]
    assert run_row(run)["state"] == "done"
    assert find_runs(tmp_path) == [run]
    assert run.is_relative_to(tmp_path / "our_runs" / "ppo_water")
