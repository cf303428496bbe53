"""Loops over worlds, compiled, and kept on the disk where there is a place for them."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import FunctionCache

_logger = logging.getLogger(__name__)
_Function = TypeVar("_Function", bound=Callable)


def compiled(function: _Function) -> _Function:
    """A function as machine code, without Python's lock and with NumPy's division by zero.

    It is compiled once for all processes. Where neither the package's folder nor the
    user's cache can be written to, as in a container, it is compiled in every process.

    Examples:
        >>> @compiled
        ... def double(x):
        ...     return 2 * x
        >>> double(1.5)
        3.0
    """
    made: Any = numba.njit(nogil=True, error_model="numpy")(function)
    try:
        # What ``cache=True`` does, with our own kind of cache.
        made._cache = _Cache(function)
    except RuntimeError:
        _say_that_nothing_is_kept()
    return made


class _Cache(FunctionCache):
    """Numba's, but a disk that becomes full or goes away does not stop who calculates.

    What is kept of a function holds until a file of its folder changes: functions and
    constants of other files are compiled into it, and Numba looks at its own file alone.
    """

    def __init__(self, function: Callable) -> None:
        super().__init__(function)
        self._cache_file._source_stamp = _stamp(Path(function.__code__.co_filename).parent)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled function, if that is possible."""
        try:
            super().save_overload(sig, data)
        except OSError:
            _say_that_nothing_is_kept()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """A function that was kept, or None."""
        try:
            return super().load_overload(sig, target_context)
        except OSError:
            _say_that_nothing_is_kept()
            return None


@functools.cache
def _stamp(folder: Path) -> list[tuple[str, float, int]]:
    """Names, times and sizes of the modules in a folder."""
    # Some editors leave links to nothing beside the files that they have open.
    files = [path for path in sorted(folder.glob("*.py")) if path.is_file()]
    stats = [path.stat() for path in files]
    return [(p.name, s.st_mtime, s.st_size) for p, s in zip(files, stats, strict=True)]


@functools.cache  # once: there are dozens of functions, and the reasons differ in names
def _say_that_nothing_is_kept() -> None:
    _logger.warning(
        "compiled functions cannot be kept, and every start takes some seconds longer: set "
        "NUMBA_CACHE_DIR to a folder that can be written to"
    )
