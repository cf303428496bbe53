"""TorchRL's archives of checkpoints, read in place: nothing is unpacked to a disk."""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

from torchrl.checkpoint import CheckpointError

from gdrl_torchrl.files.safe_files import open_to_read
from gdrl_torchrl.files.state import state_of

COMPONENT = "training"
ADAPTER = "gdrl_torchrl.safetensors"
STATE_FILE = "state.safetensors"
_MANIFEST = "manifest.json"
_MOST_BYTES_OF_MANIFEST = 2**20
_CHUNK = 2**20
_MOST_BYTES_AT_ONCE = 2**24
"""What the library may ask for: the list of an archive's members has some hundreds."""


class SavedState(NamedTuple):
    """What a checkpoint holds.

    Attributes:
        metadata: What it was saved with.
        state: The state.
    """

    metadata: dict[str, Any]
    state: Any


def read_checkpoint(path: Path) -> SavedState:
    """Read a checkpoint, whole and with its checksums, or say that it is damaged.

    Nothing is allocated for what the file only says of itself: members are stored as
    they are, so that they are no larger than the file, and are summed before they are
    kept in memory, of which no more than half of what is free is taken.

    Raises:
        CheckpointError: If it is no checkpoint, or a damaged one.
        OSError: If the system cannot read it, which says nothing about the file.
        MemoryError: If there is not enough memory, neither.
    """
    try:
        with open_to_read(path) as opened:
            _check_memory(os.fstat(opened.fileno()).st_size)
            with zipfile.ZipFile(_SmallReads(opened.fileno())) as archive:
                manifest = _manifest_of(archive)
                metadata = _typed(manifest.get("metadata", {}), dict)
                record = manifest["components"][COMPONENT]
                if record["adapter"] != ADAPTER:
                    raise ValueError(f"its adapter is {record['adapter']!r}")
                name = f"{_typed(record['path'], str)}/{STATE_FILE}"
                return SavedState(metadata, state_of(_member(archive, name)))
    except MemoryError as error:
        raise MemoryError(f"{path} cannot be read: {error or 'no memory'}") from error
    except OSError as error:
        # Of a place before the beginning, where a damaged archive sends its reader.
        if error.errno == errno.EINVAL:
            raise CheckpointError(f"it is damaged: {error}") from error
        raise OSError(error.errno, error.strerror, str(path)) from error
    # What a damaged archive makes readers raise has no common type.
    except Exception as error:
        raise CheckpointError(f"it is damaged: {error}") from error


def _manifest_of(archive: zipfile.ZipFile) -> dict[str, Any]:
    size = archive.getinfo(_MANIFEST).file_size
    if size > _MOST_BYTES_OF_MANIFEST:
        raise ValueError(f"{_MANIFEST} has {size} bytes")
    return _typed(json.loads(_member(archive, _MANIFEST)), dict)


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    member = archive.getinfo(name)
    if member.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is compressed, which no checkpoint is")
    with archive.open(member) as file:
        # The checksum is compared at its end.
        while file.read(_CHUNK):
            pass
    content = io.BytesIO()
    with archive.open(member) as file:
        shutil.copyfileobj(file, content, _CHUNK)
    return content.getvalue()


def _typed(value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise TypeError(f"{type(value).__name__} is found where a {kind.__name__} must be")
    return value


class _SmallReads(io.FileIO):
    """Reads of a file that refuses to give much at once, whatever is in it."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, closefd=False)

    def read(self, size: int | None = -1) -> bytes:
        if size is not None and size > _MOST_BYTES_AT_ONCE:
            raise ValueError(f"a list of {size} bytes")
        return super().read(size)


def _check_memory(size: int) -> None:
    """Raise MemoryError if twice a size, for bytes and tensors, is not free."""
    free = _free_memory()
    if free is not None and 2 * size > free:
        raise MemoryError(
            f"its {size / 2**30:.1f} GiB need twice as much, and "
            f"{free / 2**30:.1f} GiB are free"
        )


def _free_memory() -> int | None:
    try:
        with open("/proc/meminfo") as file:
            lines = dict(line.split(":", 1) for line in file)
        return 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None
