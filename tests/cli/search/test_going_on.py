"""Searches that were interrupted, that fail, or whose journal is damaged."""

from __future__ import annotations

import errno
import json
import re
import threading
from pathlib import Path

import pytest

from gdrl_torchrl.agents.collectors.worker import WorkerDiedError
from gdrl_torchrl.agents.update import NonFiniteUpdateError
from gdrl_torchrl.cli.trials import journal as search_journal
from gdrl_torchrl.files.directory import RunDirectory
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.safe_files import UnreadableFileError
from gdrl_torchrl.runs.run import InterruptedRunError, TrainingDivergedError
from tests.cli.search.fake_runs import FakeRuns, search_of
from tests.marks import full_but


def test_an_interrupted_search_goes_on_with_the_trial_that_was_running(tmp_path):
    options = {"num_trials": 4, "total_steps": [1000, 2000]}
    stopped = FakeRuns(tmp_path / "first", stop_at=4)
    search, _ = search_of(tmp_path, stopped, **options)
    with pytest.raises(InterruptedRunError):
        search.optimize()
    assert len(search.finished()) == 1

    again, runs = search_of(tmp_path, FakeRuns(tmp_path / "second"), **options)
    again.optimize()
    assert len(again.finished()) == 4
    interrupted = stopped.experiments[-1].evolution.mut_v
    assert runs.experiments[0].evolution.mut_v == interrupted
    values = [experiment.evolution.mut_v for experiment in runs.experiments]
    assert stopped.experiments[0].evolution.mut_v not in values
    again.optimize()
    assert len(runs.experiments) == len(values), "there is nothing left to do"


def test_the_running_trial_of_another_process_is_left_alone(tmp_path):
    began, may_end = threading.Event(), threading.Event()

    def wait(experiment):
        began.set()
        assert may_end.wait(60)
        return 0.5

    first, waiting = search_of(tmp_path, FakeRuns(tmp_path / "a", rate=wait), num_trials=2)
    worker = threading.Thread(target=first.optimize)
    worker.start()
    assert began.wait(60)
    second, runs = search_of(tmp_path, FakeRuns(tmp_path / "b"), num_trials=2)
    second.optimize()
    may_end.set()
    worker.join(60)
    states = [trial.state.name for trial in second.finished()]
    assert states == ["COMPLETE"] * 2
    assert len(runs.experiments) == 1
    tried = [e.evolution.mut_v for e in (*waiting.experiments, *runs.experiments)]
    assert len(set(tried)) == 2


@pytest.mark.parametrize("kind", ["value", "diverged"])
def test_a_trial_that_fails_does_not_end_the_search(tmp_path, kind):
    error = ValueError("mut_v=2 must be <= 1")
    if kind == "diverged":
        directory = RunDirectory(tmp_path / "run")
        error = TrainingDivergedError(NonFiniteUpdateError(["loss"], None), directory, None)
    runs = FakeRuns(tmp_path / "fake", fail_at=2, error=error)
    search, _ = search_of(tmp_path, runs, num_trials=3)
    search.optimize()
    states = [trial.state.name for trial in search.finished()]
    assert states == ["COMPLETE", "FAIL", "COMPLETE"]
    assert search.finished()[1].user_attrs["error"] == f"{type(error).__name__}: {error}"
    assert search.best().state.name == "COMPLETE"


OF_THE_MACHINE = [
    OSError(errno.ENOSPC, "No space left on device"),
    UnreadableFileError(OSError(errno.EIO, "Input/output error"), Path("config.json")),
    MemoryError("no memory"),
    RunDirectoryError("runs/a is in use by another process"),
    WorkerDiedError("killed"),
    RuntimeError("a fault of the code"),
]


@pytest.mark.parametrize(
    "error",
    full_but(OF_THE_MACHINE[:1], OF_THE_MACHINE),
    ids=lambda error: type(error).__name__,
)
def test_an_error_of_the_machine_ends_the_search_and_its_trial_is_taken_up(tmp_path, error):
    options = {"num_trials": 3}
    broken = FakeRuns(tmp_path / "first", fail_at=2, error=error)
    search, _ = search_of(tmp_path, broken, **options)
    with pytest.raises(type(error), match=re.escape(str(error))):
        search.optimize()
    assert len(broken.experiments) == 2, "it tried no other trial"
    assert [trial.state.name for trial in search.finished()] == ["COMPLETE"]
    again, runs = search_of(tmp_path, FakeRuns(tmp_path / "second"), **options)
    again.optimize()
    assert [trial.state.name for trial in again.finished()] == ["COMPLETE"] * 3
    taken_up = broken.experiments[-1].evolution.mut_v
    assert runs.experiments[0].evolution.mut_v == taken_up


def test_a_result_that_cannot_be_read_is_not_held_against_settings(tmp_path):
    runs = FakeRuns(tmp_path / "fake", rate=lambda experiment: "high")
    search, _ = search_of(tmp_path, runs)
    with pytest.raises(ValueError, match="success_rate='high'"):
        search.optimize()
    assert search.finished() == []


@pytest.mark.parametrize("kept", full_but([10], [1, 10, -2]))
def test_a_journal_whose_last_line_was_cut_goes_on(tmp_path, kept, caplog):
    search, _ = search_of(tmp_path, FakeRuns(tmp_path / "a"), num_trials=2)
    search.optimize()
    journal = search.folder / "search.journal"
    *whole, last = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(whole) + last[:kept])
    for num_trials in (3, 4):
        runs = FakeRuns(tmp_path / f"b{num_trials}")
        again, _ = search_of(tmp_path, runs, num_trials=num_trials)
        again.optimize()
        assert len(again.finished()) == num_trials
    assert "a line that was cut" in caplog.text
    assert all(json.loads(line) for line in journal.read_text().splitlines())


def test_a_journal_is_whole_after_a_disk_that_took_a_part(tmp_path, monkeypatch):
    search, _ = search_of(tmp_path, FakeRuns(tmp_path / "a"), num_trials=1)
    search.optimize()
    whole = (search.folder / "search.journal").read_bytes()

    def write_part(file, content):
        file.write(content[:7])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(search_journal, "_write_all", write_part)
        with pytest.raises(OSError, match="No space left"):
            search_of(tmp_path, FakeRuns(tmp_path / "b"), num_trials=2)[0].optimize()
    assert (search.folder / "search.journal").read_bytes() == whole


def test_a_damaged_journal_is_named(tmp_path):
    search, _ = search_of(tmp_path, num_trials=1)
    search.optimize()
    journal = search.folder / "search.journal"
    journal.write_bytes(b"no line of a journal\n" + journal.read_bytes())
    with pytest.raises(ValueError, match=r"search\.journal is damaged.*move it away"):
        search_of(tmp_path, num_trials=2)


@pytest.mark.parametrize("storage", full_but(["journal"], ["journal", "sqlite"]))
def test_a_search_writes_through_no_link(tmp_path, storage):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    folder = tmp_path / "runs" / "search"
    folder.mkdir(parents=True)
    for name in (".search.lock", f"search.{storage}", ".trial_0.lock"):
        (folder / name).symlink_to(outside)
        with pytest.raises(OSError, match="is a link"):
            search_of(tmp_path, storage=storage)[0].optimize()
        (folder / name).unlink()
        assert outside.read_text() == "mine"


def test_another_question_begins_anew_and_more_trials_do_not(tmp_path):
    search, _ = search_of(tmp_path, FakeRuns(tmp_path / "a"), num_trials=2)
    search.optimize()
    more, runs = search_of(tmp_path, FakeRuns(tmp_path / "b"), num_trials=3)
    more.optimize()
    assert len(runs.experiments) == 1
    other, _ = search_of(tmp_path, FakeRuns(tmp_path / "c"), seeds=[1])
    assert other.finished() == []
