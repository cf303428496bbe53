"""Trajectories on disk that no run can have recorded."""

from __future__ import annotations

import numpy as np
import pytest

from gdrl_torchrl.files import trajectories as trajectories_file
from gdrl_torchrl.files.trajectories import read_trajectories
from gdrl_torchrl.pictures.figures import draw_trajectories
from tests.reliability.files.readers import changes


def put(value):
    def change(array):
        array = array.astype(np.int64 if array.dtype.kind in "iu" else np.float64)
        array.reshape(-1)[0] = value
        return array

    return change


ARRAYS = sorted(trajectories_file._ALWAYS | trajectories_file._WITH_A_SEA)
CHANGES = {
    "text": lambda array: np.full(array.shape, "../../x"),
    "complex": lambda array: np.ones(array.shape, dtype=complex),
    "dates": lambda array: np.ones(array.shape).astype("datetime64[s]"),
    "record": lambda array: np.zeros(array.shape, dtype=[("a", float)]),
    "flat": lambda array: array.reshape(1, 1, 1, -1),
    "empty": lambda array: array[..., None][..., :0],
    "one more": lambda array: np.concatenate([array.reshape(-1)] * 2),
    "infinite": put(np.inf),
    "far": put(10**8),
    "minus": put(-(10**8)),
}


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    """A folder for trajectories, and whole ones, with a sea."""
    side = np.linspace(-2.0, 2.0, 5)
    sea = {"sea_x": side, "sea_y": side, "sea_elevation": np.zeros((5, 5))}
    return tmp_path_factory.mktemp("recorded"), read_trajectories(run) | sea


def read_crafted(folder, arrays):
    np.savez(folder / "trajectories.npz", **arrays)
    return read_trajectories(folder)


def changes_of(array):
    """What an array cannot be."""
    if array.dtype.kind == "U":
        # Any texts: the figure refuses those that it has no colour for.
        return ("complex", "flat", "empty")
    without = ("infinite",) if array.dtype.kind in "iu" else ()
    return tuple(change for change in CHANGES if change not in without)


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_that_cannot_be_is_refused_by_name(name, recorded):
    folder, arrays = recorded
    for change in changes_of(arrays[name]):
        crafted = {**arrays, name: CHANGES[change](arrays[name])}
        with pytest.raises(ValueError, match=r"trajectories\.npz") as refused:
            read_crafted(folder, crafted)
        assert name in str(refused.value) or change in ("one more", "empty"), change


def test_trajectories_need_their_arrays(recorded):
    folder, arrays = recorded
    assert changes(read_crafted(folder, arrays), arrays) == 0
    for name in set(ARRAYS) - {"sea_elevation"}:
        with pytest.raises(ValueError, match=rf"trajectories\.npz has no {name}"):
            read_crafted(folder, {k: v for k, v in arrays.items() if k != name})


def test_a_list_of_arrays_that_ends_early_is_refused(recorded):
    folder, arrays = recorded
    read_crafted(folder, arrays)
    path = folder / "trajectories.npz"
    content = bytearray(path.read_bytes())
    # The last but one says that all after it is a remark.
    entry = content.rfind(b"PK\x01\x02", 0, content.rfind(b"PK\x01\x02"))
    content[entry + 32 : entry + 34] = (60_000).to_bytes(2, "little")
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"npz cannot be read: .*number of arrays"):
        read_trajectories(folder)


def test_an_unknown_outcome_is_not_drawn(recorded):
    folder, arrays = recorded
    read_crafted(folder, {**arrays, "outcome_names": np.array(["../../x"] * 9)})
    with pytest.raises(ValueError, match=r"trajectories\.npz: outcome_names .*x'"):
        draw_trajectories(folder)


def test_a_small_file_with_much_in_it_is_refused(recorded, monkeypatch):
    folder, arrays = recorded
    np.savez_compressed(folder / "trajectories.npz", **arrays, zeros=np.zeros(100_000))
    assert (folder / "trajectories.npz").stat().st_size < 100_000
    monkeypatch.setattr(trajectories_file, "_MOST_BYTES", 500_000)
    with pytest.raises(ValueError, match="more than 500000 bytes"):
        read_trajectories(folder)
