"""Signals end a run once it is saved, and the same command goes on."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest

from gdrl_torchrl.files.metrics import MetricsTable
from gdrl_torchrl.files.run_table import state_of
from gdrl_torchrl.runs import report, run
from gdrl_torchrl.runs.run import InterruptedRunError, run_experiment
from gdrl_torchrl.runs.signals import _say_that_no_signal_saves, stop_signals
from tests.marks import full_but

pytestmark = pytest.mark.usefixtures("without_figures")


def interrupting(number):
    """``MetricsTable.append`` that sends a signal after the second row."""
    append = MetricsTable.append

    def append_and_interrupt(self, row):
        append(self, row)
        if row["agent_steps"] == 80:
            os.kill(os.getpid(), number)

    return append_and_interrupt


QUICK = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize(
    "number", full_but(QUICK, stop_signals()), ids=lambda number: number.name
)
def test_a_signal_saves(number, tiny, monkeypatch, rows_of):
    before = signal.getsignal(number)
    monkeypatch.setattr(MetricsTable, "append", interrupting(number))
    with pytest.raises(InterruptedRunError) as stop:
        run_experiment(tiny("checkpoint.interval_s=600"))
    assert stop.value.signal == number
    assert str(stop.value.path) in str(stop.value)
    assert signal.getsignal(number) is before
    assert state_of(stop.value.path) == "stopped"
    assert [row["agent_steps"] for row in rows_of(stop.value.path)] == ["40", "80"]
    assert len([*stop.value.path.rglob("checkpoint-*")]) == 1


def test_the_same_command_goes_on_after_a_signal(
    tiny, monkeypatch, rows_of, evaluation_of, whole_of
):
    whole, config = whole_of(tiny()), tiny("checkpoint.interval_s=600")
    with monkeypatch.context() as patch:
        patch.setattr(MetricsTable, "append", interrupting(signal.SIGTERM))
        with pytest.raises(InterruptedRunError) as stop:
            run_experiment(config)
    resumed = run_experiment(config)
    assert resumed == stop.value.path
    assert rows_of(resumed) == rows_of(whole)
    assert evaluation_of(resumed)["params_sha256"] == evaluation_of(whole)["params_sha256"]


class JobSystem:
    """What handles a signal of a job system: it queues the job again, or cannot."""

    def __init__(self, answer):
        self.answer = answer
        self.found = []

    def __call__(self, number, frame):
        (checkpoints,) = self.runs_dir.rglob("checkpoints")
        self.found.append((number, state_of(checkpoints.parent)))
        if self.answer is not None:
            raise self.answer


@pytest.mark.parametrize(
    ("answer", "expected", "says", "configured"),
    [
        (None, InterruptedRunError, "the same command goes on", "USR2"),
        (SystemExit(144), SystemExit, "144", "RTMIN"),
        (
            RuntimeError("not queued again"),
            InterruptedRunError,
            r"the same command goes on.*\(RuntimeError: not queued again\)",
            "USR2",
        ),
    ],
    ids=["nothing", "exit", "error"],
)
def test_who_handled_a_signal_before_does_so_once_the_run_is_saved(
    answer, expected, says, configured, tiny, tmp_path, monkeypatch
):
    monkeypatch.setenv("SUBMITIT_PREEMPT_SIGNAL", configured)
    number = getattr(signal, f"SIG{configured}")
    monkeypatch.setattr(MetricsTable, "append", interrupting(number))
    handler = JobSystem(answer)
    handler.runs_dir = tmp_path / "runs"
    before = signal.signal(number, handler)
    try:
        with pytest.raises(expected, match=says):
            run_experiment(tiny("checkpoint.interval_s=600"))
    finally:
        signal.signal(number, before)
    assert handler.found == [(number, "stopped")], "saved, and held by nobody"
    assert len(list(tmp_path.rglob("checkpoint-*"))) == 1


def test_a_hang_up_that_is_ignored_stays_so(tiny, monkeypatch):
    """As ``nohup`` has it."""
    monkeypatch.setattr(MetricsTable, "append", interrupting(signal.SIGHUP))
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert state_of(run_experiment(tiny())) == "done"
    finally:
        signal.signal(signal.SIGHUP, before)


STEPS = ("build_training", "evaluate_policy", "record_trajectories", "write_json")


@pytest.mark.parametrize("step", full_but(["evaluate_policy"], STEPS))
def test_a_signal_at_any_other_time_ends_a_run_too_and_it_goes_on(
    step, tiny, monkeypatch, evaluation_of, rows_of, whole_of
):
    whole = whole_of(tiny())
    place = {
        "build_training": run,
        "write_json": run.RunDirectory,
    }.get(step, report)
    inner = getattr(place, step)

    def signalled(*arguments, **options):
        os.kill(os.getpid(), signal.SIGTERM)
        return inner(*arguments, **options)

    config = tiny()
    with monkeypatch.context() as patch:
        patch.setattr(place, step, signalled)
        with pytest.raises(InterruptedRunError) as stop:
            run_experiment(config)
    assert state_of(stop.value.path) == "stopped"
    assert run_experiment(config) == stop.value.path
    assert rows_of(stop.value.path) == rows_of(whole)
    mine, other = evaluation_of(stop.value.path), evaluation_of(whole)
    assert mine["params_sha256"] == other["params_sha256"]


def test_a_run_in_a_thread_has_no_handlers_and_says_so_once(
    tiny, caplog, evaluation_of, whole_of
):
    _say_that_no_signal_saves.cache_clear()
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(run_experiment, tiny("name=first")).result()
        pool.submit(run_experiment, tiny("name=second")).result()
    said = [line for line in caplog.messages if "thread" in line]
    assert len(said) == 1
    assert "no signal makes a run save" in said[0]
    here = whole_of(tiny())
    assert evaluation_of(here)["params_sha256"] == evaluation_of(first)["params_sha256"]
