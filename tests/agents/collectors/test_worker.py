"""Objects in processes of their own: their answers, their errors, their ends."""

import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gdrl_torchrl.agents.collectors.worker import ForkedWorker, LocalWorker, WorkerDiedError
from gdrl_torchrl.runs.signals import stop_signals

KINDS = [LocalWorker, ForkedWorker]


class Counter:
    def __init__(self):
        self.count = 0

    def add(self, number):
        self.count += number
        return self.count, os.getpid()

    def echo(self, value):
        return value

    def fail(self):
        raise ValueError(f"count={self.count} is wrong")

    def fail_strangely(self):
        raise StrangeError(1, 2)

    def sleep(self, seconds):
        time.sleep(seconds)

    def close(self):
        pass


class StrangeError(Exception):
    """Cannot be made again of what it was made of, so it cannot be sent."""

    def __init__(self, one, other):
        super().__init__(f"{one} and {other}")


def ask(worker, name, *args):
    worker.begin(name, *args)
    return worker.end()


def is_gone(process_id):
    """Whether a process is not there any more, or soon will not be."""
    for _ in range(200):
        state = Path(f"/proc/{process_id}/stat")
        if not state.exists() or ") Z " in state.read_text():
            return True
        time.sleep(0.05)
    return False


@pytest.fixture
def worker():
    made = ForkedWorker(Counter)
    yield made
    made.close()


@pytest.mark.parametrize("kind", KINDS)
def test_methods_are_called_in_order_on_one_object(kind):
    worker = kind(Counter)
    where = {os.getpid(): LocalWorker}
    for number, total in ((2, 2), (3, 5), (-1, 4)):
        count, process_id = ask(worker, "add", number)
        assert count == total
        assert where.get(process_id, ForkedWorker) is kind
    worker.close()


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_larger_than_a_pipe_passes(kind):
    worker = kind(Counter)
    value = {"bytes": os.urandom(5_000_000), "none": None}
    for _ in range(3):
        assert ask(worker, "echo", value) == value
    worker.close()


def test_both_sides_work_at_the_same_time(worker):
    ask(worker, "add", 0)
    began = time.monotonic()
    worker.begin("sleep", 0.5)
    time.sleep(0.5)
    worker.end()
    assert time.monotonic() - began < 0.9


def test_errors_arrive_and_the_object_lives_on(worker):
    ask(worker, "add", 7)
    with pytest.raises(ValueError, match="count=7 is wrong") as caught:
        ask(worker, "fail")
    assert "in fail" in "".join(caught.value.__notes__), "where it was raised"
    with pytest.raises(RuntimeError, match="StrangeError: 1 and 2"):
        ask(worker, "fail_strangely")
    assert ask(worker, "add", 1)[0] == 8


def test_an_error_of_making_the_object_is_raised_at_every_call():
    def make():
        raise OSError(12, "no memory for worlds")

    worker = ForkedWorker(make)
    for _ in range(2):
        with pytest.raises(OSError, match="no memory for worlds"):
            ask(worker, "add", 1)
    worker.close()


@pytest.mark.parametrize("call", [None, "sleep"])
def test_a_killed_process_is_named_with_what_killed_it(worker, call):
    process_id = ask(worker, "add", 1)[1]
    if call is not None:
        worker.begin(call, 60.0)
    os.kill(process_id, signal.SIGKILL)
    if call is None:
        assert is_gone(process_id)
    with pytest.raises(WorkerDiedError, match=rf"{process_id}.* killed by SIGKILL.*memory"):
        worker.end() if call else ask(worker, "add", 1)
    with pytest.raises(WorkerDiedError, match="killed by SIGKILL"):
        ask(worker, "add", 1)


def test_a_closed_worker_says_so(worker):
    process_id = ask(worker, "add", 1)[1]
    worker.close()
    worker.close()
    assert is_gone(process_id)
    with pytest.raises(WorkerDiedError, match="was closed"):
        ask(worker, "add", 1)


def test_a_worker_that_nobody_holds_ends():
    worker = ForkedWorker(Counter)
    process_id = ask(worker, "add", 1)[1]
    worker.begin("sleep", 60.0)
    del worker
    assert is_gone(process_id)


def test_signals_that_a_run_saves_at_do_not_end_it(worker):
    process_id = ask(worker, "add", 1)[1]
    for number in stop_signals():
        os.kill(process_id, number)
        assert ask(worker, "add", 1)[1] == process_id


def test_any_signal_that_its_maker_may_be_told_to_answer_does_not_end_it(worker):
    process_id = ask(worker, "add", 1)[1]
    for number in (signal.SIGALRM, signal.SIGPROF, signal.SIGRTMIN, signal.SIGRTMIN + 3):
        os.kill(process_id, number)
        assert ask(worker, "add", 1)[1] == process_id


def test_a_signal_while_a_worker_is_made_is_its_makers_alone():
    said = []
    before = signal.signal(signal.SIGUSR2, lambda *ignored: said.append(os.getpid()))
    fork = os.fork

    def fork_and_signal():
        process_id = fork()
        os.kill(process_id or os.getpid(), signal.SIGUSR2)
        return process_id

    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "fork", fork_and_signal)
            worker = ForkedWorker(lambda: said)
        os.kill(os.getpid(), signal.SIGUSR2)
        assert ask(worker, "copy") == []
        assert said == [os.getpid()]
    finally:
        signal.signal(signal.SIGUSR2, before)
        worker.close()


@pytest.mark.parametrize(
    ("end", "said"),
    [
        (lambda: os._exit(3), "ended with exit code 3"),
        (os.abort, r"killed by SIGABRT \(exit code -6\)"),
    ],
)
def test_memory_is_not_blamed_for_what_it_does_not_do(end, said):
    worker = ForkedWorker(lambda: Ending(end))
    with pytest.raises(WorkerDiedError, match=said) as died:
        ask(worker, "end")
    assert "memory" not in str(died.value)
    worker.close()


class Ending:
    def __init__(self, end):
        self.end = end


def test_a_worker_holds_no_lock_of_its_maker(tmp_path):
    with open(tmp_path / "lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        worker = ForkedWorker(Counter)
        ask(worker, "add", 1)
    with open(tmp_path / "lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    worker.close()


@pytest.mark.parametrize(
    "end",
    [
        pytest.param("return", marks=pytest.mark.full),
        pytest.param("error", marks=pytest.mark.full),
        "SIGKILL",
    ],
)
def test_workers_end_with_their_maker(end):
    """One is idle, and one that was made later, and knew the other's pipe, is at work."""
    script = f"""
        import os, signal, sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from test_worker import Counter, ForkedWorker, ask
        workers = [ForkedWorker(Counter) for _ in range(2)]
        print(*(ask(worker, "add", 1)[1] for worker in workers), flush=True)
        workers[1].begin("sleep", 2)
        if {end!r} == "SIGKILL":
            os.kill(os.getpid(), signal.SIGKILL)
        elif {end!r} == "error":
            raise SystemExit("an error")
    """
    lines = "\n".join(line[8:] for line in script.splitlines())
    done = subprocess.run(
        [sys.executable, "-c", lines],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    code = {"return": 0, "error": 1, "SIGKILL": -signal.SIGKILL}[end]
    assert done.returncode == code, done.stderr
    first, second = map(int, done.stdout.split())
    assert is_gone(first)
    assert is_gone(second)
