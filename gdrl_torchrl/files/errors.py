"""Errors about run directories."""

from __future__ import annotations

from pathlib import Path


class RunDirectoryError(RuntimeError):
    """A run directory that cannot be used, and what to do about it."""


class RunInUseError(RunDirectoryError):
    """Another process works at the run, here or on another machine.

    Attributes:
        path: The run directory.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(
            f"{path} is in use by another process: wait for it, or end it first"
        )
        self.path = path
