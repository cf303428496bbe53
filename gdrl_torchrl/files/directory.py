"""A run is a directory named by its configuration."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gdrl_torchrl.files.errors import RunDirectoryError, RunInUseError
from gdrl_torchrl.files.fields import COUNT, OBJECT, SECONDS, TEXT, Kind, read_object
from gdrl_torchrl.files.safe_files import aside_of, locked, written_aside

_logger = logging.getLogger(__name__)
_VERSIONS = Kind(
    "an object of texts",
    lambda x: isinstance(x, dict) and all(map(TEXT.fits, [*x.keys(), *x.values()])),
)
_FIELDS: Mapping[str, Mapping[str, Kind]] = {
    "provenance.json": {"code": TEXT, "packages": _VERSIONS},
    "DONE": {
        "code": TEXT,
        "costs.agent_steps": COUNT,
        "costs.total_steps": COUNT,
        "costs.wall_s": SECONDS,
        "evaluation": OBJECT,
    },
}
"""What is read of files."""
_OF_LATER = {"version": COUNT, "before": Kind("a list", lambda x: isinstance(x, list))}
"""What files of before there were versions do not have."""
_WRITTEN = (
    *_FIELDS,
    "FAILED",
    "config.json",
    "overrides.json",
    "evaluation.json",
    "metrics.csv",
    "trajectories.npz",
)
"""What is written aside before it gets its name."""


@dataclasses.dataclass(frozen=True)
class RunDirectory:
    """``<runs_dir>/<name>/<key>/seed_<seed>``."""

    path: Path

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def metrics(self) -> Path:
        """The table of training."""
        return self.path / "metrics.csv"

    @property
    def done(self) -> Path:
        """Present once a run is complete; says with which costs and version."""
        return self.path / "DONE"

    @property
    def failed(self) -> Path:
        """Present if the last start ended in an error; says which."""
        return self.path / "FAILED"

    def write_json(self, name: str, content: Mapping[str, Any]) -> Path:
        """Write a file atomically."""
        path = self.path / name
        with written_aside(path) as aside:
            aside.write_text(json.dumps(content, indent=2) + "\n")
        return path

    def read_json(self, name: str) -> dict[str, Any] | None:
        """Read a file; None if there is none.

        Raises:
            RunDirectoryError: If it is not JSON, or a field that is read is missing or
                not what it must be.
        """
        path = self.path / name
        if not path.exists():
            return None
        try:
            return read_object(path, _FIELDS.get(name, {}), _OF_LATER)
        except OSError as error:
            # It may well be whole.
            raise RunDirectoryError(str(error)) from error
        except ValueError as error:
            raise RunDirectoryError(
                f"{error}: remove this file to go on without it"
            ) from error

    def clean(self) -> None:
        """Remove what a killed process, or one on a full disk, had not finished."""
        for name in _WRITTEN:
            aside_of(self.path / name).unlink(missing_ok=True)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes out; the lock of a killed process blocks nobody.

        Raises:
            RunDirectoryError: If another process holds it, or it is no file.
            OSError: If it cannot be opened, or is a link.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise RunDirectoryError(
                f"{self.path} is not a folder: remove it, or mount what it leads to"
            ) from error
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(locked(self.path / ".lock"))
            except BlockingIOError as error:
                raise RunInUseError(self.path) from error
            except ValueError as error:
                raise RunDirectoryError(f"{error}: remove it") from error
            yield
