"""MuJoCo's warnings in our log, instead of on the terminal and in a file of its own."""

from __future__ import annotations

import logging
import threading
from typing import Any

import mujoco

_logger = logging.getLogger(__name__)


class quiet_engine:  # noqa: N801 - used like a function
    """Send MuJoCo's warnings to our log, not to the terminal or a file.

    Any number of threads may be inside; the last one to leave restores the old handling.
    """

    __slots__ = ()
    _lock = threading.Lock()
    _inside = 0
    _previous: Any = None

    # A class, because it is entered at every step and a generator takes twice the time.
    def __enter__(self) -> None:
        own = quiet_engine
        with own._lock:
            if own._inside == 0:
                own._previous = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(_log_warning)
            own._inside += 1

    def __exit__(self, *error: object) -> None:
        own = quiet_engine
        with own._lock:
            own._inside -= 1
            if own._inside == 0:
                mujoco.set_mju_user_warning(own._previous)


def _log_warning(message: str) -> None:
    _logger.debug("MuJoCo: %s", message)
