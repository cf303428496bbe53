"""Reading ``trajectories.npz``: arrays, never objects, whose shapes fit each other."""

from __future__ import annotations

import dataclasses
import io
import math
import zipfile
from pathlib import Path

import numpy as np

from gdrl_torchrl.files.safe_files import read_content, written_aside

_MOST_BYTES = 2**31
"""Of all arrays: a small file may say that it holds more than any memory."""
_FAR = 1e7
"""Metres from the origin; a vehicle so far out has diverged before."""


@dataclasses.dataclass(frozen=True)
class _Array:
    """What an array must be.

    Attributes:
        kinds: Letters of NumPy's kinds of data.
        shape: Lengths; what has the same letter has the same length.
        least: Least value.
        most: Largest value.
        may_be_nan: Whether values may be NaN, as after the end of an episode.
    """

    kinds: str
    shape: tuple[str | int, ...]
    least: float = -_FAR
    most: float = _FAR
    may_be_nan: bool = False


_ALWAYS = {
    "position": _Array("f", ("steps + 1", "episodes", 2), may_be_nan=True),
    "heading": _Array("f", ("steps + 1", "episodes"), may_be_nan=True),
    "goal": _Array("f", ("episodes", 2)),
    "outcome": _Array("iu", ("episodes",), least=0),
    "steps": _Array("iu", ("episodes",), least=0),
    "outcome_names": _Array("U", ("outcomes",)),
    "tolerance": _Array("f", (), least=1e-6),
    "control_interval_s": _Array("f", (), least=1e-6),
}
_WITH_A_SEA = {
    "sea_x": _Array("f", ("columns",)),
    "sea_y": _Array("f", ("rows",)),
    "sea_elevation": _Array("f", ("rows", "columns")),
}
_WITH_OBSTACLES = {
    "obstacles": _Array("f", ("episodes", "shapes", 4)),
    "obstacle_is_box": _Array("b", ("shapes",), least=0),
    "obstacle_half_size": _Array("f", ("shapes", 2), least=0.0),
    "half_extent": _Array("f", (2,), least=0.1, most=100.0),
    "vehicle_outline": _Array("f", ("corners", 2)),
}


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read every array of an npz file, whole and with its checksum.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is damaged, or an array is of objects, which would be pickled.
    """
    content = read_content(path, _MOST_BYTES)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            # The last 22 bytes count them: a damaged list may end before its end.
            if len(members) != int.from_bytes(content[-12:-10], "little"):
                raise ValueError(f"it has another number of arrays than {len(members)}")
            if sum(member.file_size for member in members) > _MOST_BYTES:
                raise ValueError(f"its arrays have more than {_MOST_BYTES} bytes")
            return {
                member.filename.removesuffix(".npy"): _array_of(archive, member)
                for member in members
            }
    # What a damaged archive makes readers raise has no common type.
    except Exception as error:
        raise ValueError(f"{path} cannot be read: {error}") from error


def check_trajectories(arrays: dict[str, np.ndarray], path: Path) -> None:
    """Raise ValueError unless arrays fit each other and hold what can be drawn."""
    expected = dict(_ALWAYS)
    for name, others in (("sea_elevation", _WITH_A_SEA), ("obstacles", _WITH_OBSTACLES)):
        if name in arrays:
            expected |= others
    lengths: dict[str, int] = {}
    for name, rule in expected.items():
        if name not in arrays:
            raise ValueError(f"{path} has no {name}")
        _check_type(arrays[name], rule, lengths, f"{path}: {name}")
        _check_values(arrays[name], rule, f"{path}: {name}")
    last = lengths["steps + 1"] - 1
    _check_values(arrays["steps"], _Array("iu", (), 0, last), f"{path}: steps")
    last = lengths["outcomes"] - 1
    _check_values(arrays["outcome"], _Array("iu", (), 0, last), f"{path}: outcome")
    for name in {"sea_x", "sea_y"} & expected.keys():
        if len(arrays[name]) < 2 or not (np.diff(arrays[name]) > 0.0).all():
            raise ValueError(f"{path}: {name} must be two or more numbers that increase")


def _array_of(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as file:
        # All of it, for only then the checksum is compared; no more than was said.
        stream = io.BytesIO(file.read(member.file_size))
    _check_length(stream, member)
    array = np.lib.format.read_array(stream, allow_pickle=False)
    if stream.read(1):
        raise ValueError(f"{member.filename} goes on after its end")
    return array


def _check_length(stream: io.BytesIO, member: zipfile.ZipInfo) -> None:
    """Raise ValueError unless an array has as many bytes as its first line says.

    NumPy makes the array before it reads what is to be in it.
    """
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"{member.filename} is of version {version}")
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    size = math.prod(shape) * dtype.itemsize
    if size != member.file_size - stream.tell() and not dtype.hasobject:
        raise ValueError(f"{member.filename} has not the {size} bytes of its shape")
    stream.seek(0)


def _check_type(
    array: np.ndarray, rule: _Array, lengths: dict[str, int], name: str
) -> None:
    found = f"{array.dtype} {list(array.shape)}"
    shape = list(rule.shape)
    if array.dtype.kind not in rule.kinds or array.ndim != len(shape):
        raise ValueError(f"{name} is {found}, expected kind {rule.kinds!r} and {shape}")
    for length, expected in zip(array.shape, rule.shape, strict=True):
        if isinstance(expected, str):
            expected = lengths.setdefault(expected, length)
        if length != expected or length == 0:
            raise ValueError(f"{name} is {found}, expected {shape} with {lengths}")


def _check_values(array: np.ndarray, rule: _Array, name: str) -> None:
    if array.dtype.kind == "U":
        return
    # Written so that NaN is wrong.
    right = (array >= rule.least) & (array <= rule.most)
    if rule.may_be_nan:
        right |= np.isnan(array)
    if not right.all():
        wrong = array[~right][0]
        raise ValueError(
            f"{name} has {wrong}, expected numbers from {rule.least:g} to {rule.most:g}"
        )


TRAJECTORIES_FILE = "trajectories.npz"


def read_trajectories(run_dir: str | Path) -> dict[str, np.ndarray]:
    """Read the recorded episodes.

    Args:
        run_dir: Directory of the run.

    Returns:
        Arrays by name, see :func:`gdrl_torchrl.pictures.film.episodes.record_trajectories`.

    Raises:
        FileNotFoundError: If there is no ``trajectories.npz``.
        ValueError: If it is damaged, or an array is missing or not what it must be.
    """
    path = Path(run_dir) / TRAJECTORIES_FILE
    arrays = read_arrays(path)
    check_trajectories(arrays, path)
    return arrays


def save_trajectories(run_dir: str | Path, trajectories: dict[str, np.ndarray]) -> Path:
    """Write ``trajectories.npz`` into a run directory.

    Args:
        run_dir: Directory of the run.
        trajectories: Arrays of :func:`record_trajectories`.

    Returns:
        The file written.
    """
    path = Path(run_dir) / TRAJECTORIES_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path) as aside:
        np.savez_compressed(aside, allow_pickle=False, **trajectories)
    return path
