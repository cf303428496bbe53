"""Signals that ask a run to end: they are answered when nothing is lost by it."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

_logger = logging.getLogger(__name__)
_SIGNALS = (
    *(signal.SIGINT, signal.SIGTERM, signal.SIGHUP),
    # What job systems send before a time limit.
    *(signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU),
)
_OF_SUBMITIT = "SUBMITIT_PREEMPT_SIGNAL"
"""Environment variable with the name, without SIG, of the signal it sends before that."""


class StoppedError(BaseException):
    """A signal ends what goes on at once. No error, which might be caught as one."""


class StopSignals:
    """Notes signals that ask a process to end, instead of being ended by them.

    Entered in a thread other than the main one, where Python lets nobody handle signals,
    it notes none, and says so once. A hang-up stays ignored where it was, as by ``nohup``.

    Attributes:
        received: The signals, in the order in which they came.

    Examples:
        >>> with StopSignals() as signals:
        ...     signal.raise_signal(signal.SIGTERM)
        >>> signals.received[0].name
        'SIGTERM'
    """

    def __init__(self) -> None:
        self.received: list[signal.Signals] = []
        self._ends_at_once = False
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is not threading.main_thread():
            _say_that_no_signal_saves()
            return self
        for number in stop_signals():
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._handlers[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._handlers.items():
            # None is a handler that was not installed by Python; it cannot be put back.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._handlers.clear()

    @contextlib.contextmanager
    def ending_at_once(self) -> Iterator[None]:
        """Raise StoppedError as soon as there is a signal, or if there was one."""
        self._ends_at_once = True
        try:
            if self.received:
                raise StoppedError
            yield
        finally:
            self._ends_at_once = False

    def hand_on(self) -> None:
        """Call the handlers that others had for what was received, as job systems have.

        Raises:
            BaseException: Whatever they raise; one that queues a job again exits.
        """
        for number in self.received:
            handler: Any = signal.getsignal(number)
            if callable(handler) and handler is not signal.default_int_handler:
                handler(number, None)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received.append(signal.Signals(number))
        name = self.received[-1].name
        if self._ends_at_once:
            self._ends_at_once = False
            _logger.warning("%s: ending; everything is saved", name)
            raise StoppedError
        _logger.warning("%s: finishing this iteration, then saving", name)


def stop_signals() -> list[signal.Signals]:
    """The signals that end a run once it is saved."""
    configured: Any = getattr(signal, f"SIG{os.environ.get(_OF_SUBMITIT)}", None)
    return [*_SIGNALS, *({configured} - {None, *_SIGNALS})]


@functools.cache
def _say_that_no_signal_saves() -> None:
    _logger.warning(
        "training in a thread: no signal makes a run save and stop here, which only the "
        "main thread could; what checkpoint.interval_s has saved is not lost"
    )
