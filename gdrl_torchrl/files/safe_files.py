"""Files of a run, opened so that links, pipes and sizes do no harm.

A run directory may hold what somebody else put there. What is written goes into files and
folders of the run's own, never through a link; what is read is a file of bounded size.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_LINKED = (
    "is a link, and a run writes only into files and folders of its own: set runs_dir to "
    "the other place, or link the whole run directory"
)
# A pipe without a writer must not be waited for.
_ALWAYS = os.O_NONBLOCK | os.O_CLOEXEC


class UnreadableFileError(OSError, ValueError):
    """A file that the system cannot read: nothing is known of what is in it."""

    def __init__(self, error: OSError, path: Path) -> None:
        super().__init__(f"{path} cannot be read: {error.strerror or error}")
        self.errno = error.errno


def open_to_read(path: Path) -> BinaryIO:
    """Open a file, by a link too.

    Raises:
        OSError: If it cannot be opened.
        ValueError: If it is no file: a pipe, a device or a folder.
    """
    descriptor = os.open(path, os.O_RDONLY | _ALWAYS)
    _check_is_file(descriptor, path)
    return open(descriptor, "rb")


def read_content(path: Path, most_bytes: int) -> bytes:
    """Read a file that is not larger than it may be.

    Raises:
        FileNotFoundError: If there is none.
        UnreadableFileError: If the system cannot read it.
        ValueError: If it is no file, or too large.
    """
    try:
        with open_to_read(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > most_bytes:
                raise ValueError(f"{path} has {size} bytes, the most are {most_bytes}")
            # No more than that, if it grows.
            return file.read(size)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise UnreadableFileError(error, path) from error


def open_own(path: Path, flags: int) -> int:
    """Open a file of a run's own to write: its descriptor.

    Args:
        path: The file.
        flags: Of ``os.open``; what is there is kept unless they say otherwise.

    Raises:
        OSError: If it is a link, or cannot be opened.
        ValueError: If it is no file.
    """
    try:
        descriptor = os.open(path, flags | os.O_NOFOLLOW | _ALWAYS, 0o666)
    except OSError as error:
        if path.is_symlink():
            raise OSError(errno.ELOOP, _LINKED, str(path)) from error
        raise
    _check_is_file(descriptor, path)
    return descriptor


def own_folder(path: Path) -> Path:
    """Make a folder of a run's own, if there is none.

    Raises:
        OSError: If it is a link, or cannot be made.
    """
    if path.is_symlink():
        raise OSError(errno.ELOOP, _LINKED, str(path))
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise NotADirectoryError(errno.ENOTDIR, "is not a folder", str(path)) from error
    return path


def aside_of(path: Path) -> Path:
    """Where a file is written before it gets its name.

    Examples:
        >>> aside_of(Path("figures/curve.png")).as_posix()
        'figures/.curve.partial.png'
    """
    return path.with_name(f".{path.stem}.partial{path.suffix}")


def new_aside(path: Path) -> Path:
    """Make a new, empty file beside another.

    Raises:
        OSError: If it cannot be made.
    """
    aside = aside_of(path)
    # What a killed process left, or somebody else put there.
    aside.unlink(missing_ok=True)
    os.close(open_own(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
    return aside


@contextlib.contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """A new, empty file beside another, whose name it gets once it is written.

    A reader never sees half a file, and after an error there is what was there before.

    Raises:
        OSError: If it cannot be made or written.
    """
    aside = new_aside(path)
    try:
        yield aside
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock on a file, which is made if there is none and keeps its content.

    Args:
        path: The file.
        wait: Whether to wait until no other process holds it.

    Raises:
        BlockingIOError: If another process holds it and ``wait`` is not set.
        OSError: If it is a link, or cannot be opened.
        ValueError: If it is no file.
    """
    descriptor = open_own(path, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
    finally:
        os.close(descriptor)


def _check_is_file(descriptor: int, path: Path) -> None:
    """Raise ValueError, with the descriptor closed, unless it is that of a file."""
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ValueError(f"{path} is not a file")
