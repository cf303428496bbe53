"""An object in a process of its own, whose methods are called from here."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import pickle
import signal
import traceback
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from typing import Any

import torch

_NOT_IGNORED = {
    *(signal.SIGKILL, signal.SIGSTOP),  # these cannot be
    # Faults of the process itself, and the control of jobs and children.
    *(signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT),
    *(signal.SIGTRAP, signal.SIGSYS, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU),
    *(signal.SIGCONT, signal.SIGCHLD),
}
"""All others may be answered by a run's own process, by saving: it needs its workers."""
_SECONDS_TO_DIE = 5.0


class WorkerDiedError(RuntimeError):
    """A worker's process is gone."""


class LocalWorker:
    """As :class:`ForkedWorker`, in the caller's process: a call ends before it returns.

    Args:
        make: Makes the object.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        self._object = make()
        self._answer: Any = None

    def begin(self, name: str, *args: Any) -> None:
        """Call a method."""
        self._answer = getattr(self._object, name)(*args)

    def end(self) -> Any:
        """What the method that was called last returned."""
        answer, self._answer = self._answer, None
        return answer

    def close(self) -> None:
        """Close the object."""
        self._object.close()


class ForkedWorker:
    """Calls methods of an object that lives in a forked process, one after the other.

    A fork costs milliseconds where a new interpreter would import torch for seconds, and
    the object may be made of anything that is here. Its process keeps no file, lock or
    connection of this one, runs torch on one thread, is not ended by any signal that a
    run may save at, and dies with this object or with the process that made it.

    Args:
        make: Makes the object, in the new process.

    Examples:
        >>> worker = ForkedWorker(lambda: [3, 1, 2])
        >>> worker.begin("sort")
        >>> worker.end()
        >>> worker.begin("pop")
        >>> worker.end()
        3
        >>> worker.close()
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(make, theirs), name="gdrl-worker", daemon=True
        )
        with warnings.catch_warnings():
            # That another thread may hold a lock. Nothing that a worker does takes a lock
            # of what was there before it.
            warnings.simplefilter("ignore", DeprecationWarning)
            # What comes before the process ignores it waits until then, and is dropped.
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, _ignored())
            try:
                self._process.start()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        theirs.close()
        # Not by atexit: multiprocessing waits there for processes that are not ended.
        parts = (self._process, self._connection)
        self._finalize = Finalize(self, _end, parts, exitpriority=1)

    def begin(self, name: str, *args: Any) -> None:
        """Have a method called.

        Raises:
            WorkerDiedError: If the process is gone.
        """
        try:
            self._connection.send((name, args))
        except OSError as error:
            raise self._death() from error

    def end(self) -> Any:
        """Wait for what the method that was called last returns.

        Raises:
            WorkerDiedError: If the process is gone.
            Exception: Whatever the method raised, or the making of the object.
        """
        try:
            error, answer = self._connection.recv()
        except (EOFError, OSError) as broken:
            raise self._death() from broken
        if error is not None:
            raise error
        return answer

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self._finalize()

    def _death(self) -> WorkerDiedError:
        if not self._finalize.still_active():
            return WorkerDiedError("the worker was closed")
        self._process.join(_SECONDS_TO_DIE)
        code = self._process.exitcode
        return WorkerDiedError(
            f"process {self._process.pid}, a worker of this one, {_how_ended(code)}"
        )


def _how_ended(code: int | None) -> str:
    if code is None:
        return "does not answer"
    if code >= 0:
        return f"ended with exit code {code}"
    name = signal.Signals(-code).name
    how = f"was killed by {name} (exit code {code})"
    if name == "SIGKILL":
        how += "; a system that is short of memory kills processes so"
    return how


def _ignored() -> set[signal.Signals]:
    return signal.valid_signals() - _NOT_IGNORED


def _end(process: Any, connection: Connection) -> None:
    # It listens to no other signal, and has nothing to save.
    process.kill()
    process.join()
    connection.close()


def _serve(make: Callable[[], Any], connection: Connection) -> None:
    """Call methods until the other side is gone."""
    for number in _ignored():
        signal.signal(number, signal.SIG_IGN)
    # A mask may have been there before, but not for this.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _ignored())
    _close_files_but(connection.fileno())
    # Objects of the other side stay as they are: their threads are not here.
    gc.freeze()
    torch.set_num_threads(1)
    made: Any = None
    failure: Exception | None = None
    try:
        made = make()
    except Exception as error:
        failure = _told(error)
    with contextlib.suppress(EOFError, OSError):
        while True:
            name, args = connection.recv()
            answer = failure, None
            if failure is None:
                try:
                    answer = None, getattr(made, name)(*args)
                except Exception as error:
                    answer = _told(error), None
            connection.send(answer)


def _told(error: Exception) -> Exception:
    """An error that says where it happened, for its traceback stays behind."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    error.add_note(f"In a worker process:\n{traceback.format_exc()}")
    return error


def _close_files_but(kept: int) -> None:
    """Close inherited files: a lock is held, and a pipe open, as long as anyone has it."""
    for number in map(int, os.listdir("/proc/self/fd")):
        if number > 2 and number != kept:
            with contextlib.suppress(OSError):
                os.close(number)
