"""Runs that are killed again and again end as if nothing had been.

Real processes, killed by SIGKILL at seeded moments: in the middle of saving, of an
evaluation, of a hand-over, or anywhere. The quick part kills one run twice; the full part
kills every experiment.
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.evolution.settings import ErlConfig

KILLABLE = Path(__file__).with_name("killable.py")
COMMAND = Path(sysconfig.get_path("scripts")) / "gdrl-train"
STAGES = {"anywhere": 1, "saving": 5, "evaluation": 8, "hand-over": 3}


def moments_of(experiment, count, rows):
    """Seeded moments, one per life of the process, in order of rows."""
    choose = random.Random(f"kills of {experiment}")
    config = load_experiment([f"experiment={experiment}"])
    kinds = ["anywhere", "saving"]
    if config.evolution.enabled or config.algorithm.name == "ga":
        kinds.append("evaluation")
    if config.evolution.enabled and not isinstance(config.evolution, ErlConfig):
        kinds.append("hand-over")
    # Every kind in turn, so that few kills are of as many kinds as can be.
    order = [kinds[number % len(kinds)] for number in range(count)]
    choose.shuffle(order)
    last = max(count, int(0.7 * rows))
    due = sorted(choose.sample(range(1, last + 1), count))
    for row, kind in zip(due, order, strict=True):
        yield {"row": row, "kind": kind, "stage": choose.randrange(STAGES[kind])}


def live(options, folder, moment):
    """Start a process and wait until it has been killed."""
    choose = random.Random(str(moment["row"]))
    # A kill must not always find everything saved, nor nothing.
    interval_s = 0 if moment["kind"] == "saving" else choose.choice([0, 0.2])
    arguments = [
        json.dumps(moment),
        *options,
        f"runs_dir={folder}",
        f"checkpoint.interval_s={interval_s}",
        f"simulation.num_threads={choose.choice([1, 2])}",
    ]
    with (folder / "log").open("a") as log:
        process = subprocess.Popen(
            [sys.executable, str(KILLABLE), *arguments],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
        )
        assert process.stdout is not None
        for line in process.stdout:
            if line == "ready\n":
                time.sleep(choose.uniform(0.0, 0.1))
                process.kill()
        code = process.wait(timeout=120)
    said = (folder / "log").read_text()[-2000:]
    assert code == -signal.SIGKILL, f"not killed while it trained, at {moment}: {said}"


def finished(options, folder):
    """Start the plain command and wait for its end; the run directory."""
    done = subprocess.run(
        [COMMAND, *options, f"runs_dir={folder}", "simulation.num_threads=1"],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return Path(done.stdout.splitlines()[-1])


def curves_of(run):
    """Steps and values of each of TensorBoard's curves, but the clock."""
    events = EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    return {
        name: [(event.step, event.value) for event in events.Scalars(name)]
        for name in events.Tags()["scalars"]
        if not name.startswith("time/")
    }


@pytest.fixture
def check_chain(tmp_path, options_of, rows_of, evaluation_of):
    """Kills a run a few times; what the process was in the middle of."""

    def check(experiment, count):
        options = options_of(experiment)
        folders = [tmp_path / name for name in ("whole", "killed")]
        for folder in folders:
            folder.mkdir()
        whole = finished(options, folders[0])
        log = tmp_path / "kills"
        moments = moments_of(experiment, count, len(rows_of(whole)))
        for number, moment in enumerate(moments, 1):
            live(options, folders[1], moment | {"log": str(log)})
            assert len(log.read_text().splitlines()) == number
            assert not list(folders[1].rglob("DONE"))
        killed = finished(options, folders[1])
        assert evaluation_of(killed) == evaluation_of(whole)
        assert rows_of(killed) == rows_of(whole)
        assert curves_of(killed) == curves_of(whole)
        for name in ("final/policy.safetensors", "final/contract.json"):
            assert (killed / name).read_bytes() == (whole / name).read_bytes(), name
        one, other = (np.load(run / "trajectories.npz") for run in (whole, killed))
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])
        kills = [json.loads(line) for line in log.read_text().splitlines()]
        digest = evaluation_of(killed)["params_sha256"][:12]
        where = [f"{kill['kind']} {kill['stage']}@{kill['rows']}" for kill in kills]
        print(f"{experiment}: {count} kills, {digest} as without: {', '.join(where)}")
        return {kill["kind"] for kill in kills}

    return check


@pytest.mark.full
def test_a_killed_run_ends_as_one_that_was_not(check_chain):
    check_chain("grainbow_indoor", 2)


@pytest.mark.full
@pytest.mark.parametrize("experiment", ["grainbow_indoor", "gppo_water"])
def test_a_run_survives_25_kills(experiment, check_chain):
    assert check_chain(experiment, 25) >= STAGES.keys()


@pytest.mark.full
def test_every_other_experiment_survives_3_kills(any_experiment, check_chain):
    check_chain(any_experiment, 3)


@pytest.mark.full
@pytest.mark.parametrize("number", ["SIGTERM", "SIGINT", "SIGUSR1"])
def test_a_signal_saves_at_the_next_row_and_exits_with_75(
    number, tmp_path, options_of, rows_of, evaluation_of
):
    options = options_of("grainbow_water")
    whole = finished(options, tmp_path / "whole")
    arguments = [*options, f"runs_dir={tmp_path / 'told'}", "checkpoint.interval_s=1000"]
    process = subprocess.Popen(
        [COMMAND, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    while not [run for run in tmp_path.rglob("told/**/metrics.csv") if rows_of(run.parent)]:
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.Signals[number])
    _, said = process.communicate(timeout=60)
    assert process.returncode == 75, said
    assert f"stopped by {number} and saved" in said
    assert "Traceback" not in said
    (saved,) = tmp_path.rglob("told/**/checkpoint-*")
    (run,) = [path.parent for path in tmp_path.rglob("told/**/metrics.csv")]
    assert int(rows_of(run)[-1]["total_steps"]) == int(saved.stem.split("-")[1])
    assert len(rows_of(run)) < len(rows_of(whole))
    assert finished(options, tmp_path / "told") == run
    assert evaluation_of(run) == evaluation_of(whole)
    assert rows_of(run) == rows_of(whole)
