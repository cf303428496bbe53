"""Checkpoints that are damaged, foreign, crafted or cannot be written."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import random
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import NonTensorData, TensorDict
from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.files import checkpoint as checkpoint_file
from gdrl_torchrl.files import state as state_file
from gdrl_torchrl.runs import checkpoint
from gdrl_torchrl.runs.checkpoint import Checkpoints
from gdrl_torchrl.runs.run import run_experiment

IDENTITY = {"configuration": "0123abcd", "seed": 0}


class State:
    """Something with a state, which counts how often it was restored."""

    def __init__(self, content=None):
        self.content = content
        self.restored = 0

    def state_dict(self):
        return self.content

    def load_state_dict(self, state_dict):
        self.content = state_dict
        self.restored += 1


def content_of(step):
    generator = np.random.default_rng(step)
    return {
        "step": step,
        "weights": torch.from_numpy(generator.normal(size=200)),
        "nested": {3: [np.arange(5) * step, None, (True, float("nan"), "text")]},
    }


def checkpoints_of(folder, state, identity=IDENTITY):
    return Checkpoints(folder, state, identity, keep=2)


@pytest.fixture
def saved(tmp_path):
    """A folder with checkpoints of steps 10 and 20."""
    for step in (10, 20):
        checkpoints_of(tmp_path, State(content_of(step))).save(step)
    return tmp_path


def assert_same(found, expected):
    assert type(found) is type(expected)
    if isinstance(expected, dict):
        assert list(found) == list(expected)
        for key in expected:
            assert_same(found[key], expected[key])
    elif isinstance(expected, (list, tuple)):
        assert len(found) == len(expected)
        for pair in zip(found, expected, strict=True):
            assert_same(*pair)
    elif isinstance(expected, torch.Tensor):
        torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)
    else:
        np.testing.assert_array_equal(found, expected)


numbers = st.integers(-(2**63), 2**63 - 1) | st.floats() | st.booleans() | st.none()
leaves = (
    numbers
    | st.text(max_size=5)
    | st.lists(st.floats(width=32), max_size=3).map(
        lambda x: torch.tensor(x, dtype=torch.float32)
    )
    | st.sampled_from(["uint8", "int64", "float64", "bool", "uint64"]).map(
        lambda kind: np.ones((2, 0, 3) if kind == "bool" else (2, 2), dtype=kind)
    )
)
states = st.recursive(
    leaves,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text(max_size=3) | st.integers(0, 9), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(deadline=None, max_examples=40)
@given(content=st.dictionaries(st.text(max_size=3), states, max_size=4))
def test_a_state_comes_back_as_it_was(content, tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints")
    checkpoints_of(folder, State(content)).save(1)
    back = State()
    assert checkpoints_of(folder, back).load_latest()
    assert_same(back.content, content)


def test_the_newest_is_restored_and_only_so_many_are_kept(saved):
    checkpoints_of(saved, State(content_of(30))).save(30)
    assert sorted(path.name for path in saved.iterdir()) == [
        "checkpoint-000000000020.torchrl",
        "checkpoint-000000000030.torchrl",
    ]
    state = State()
    assert checkpoints_of(saved, state).load_latest()
    assert_same(state.content, content_of(30))


def test_without_checkpoints_nothing_is_restored(tmp_path):
    state = State()
    assert not checkpoints_of(tmp_path / "none", state).load_latest()
    assert state.restored == 0


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_a_damaged_checkpoint_is_never_restored_wrongly(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints")
    for step in (10, 20):
        newest = checkpoints_of(folder, State(content_of(step))).save(step)
    whole = bytearray(newest.read_bytes())
    at = data.draw(st.integers(0, len(whole) - 1))
    if data.draw(st.booleans()):
        newest.write_bytes(whole[:at])
        possible = [10]
    else:
        whole[at] ^= 1 << data.draw(st.integers(0, 7))
        newest.write_bytes(whole)
        # A few bytes, such as the time of writing in the archive, mean nothing.
        possible = [10, 20]
    state = State()
    assert checkpoints_of(folder, state).load_latest()
    assert state.restored == 1
    assert state.content["step"] in possible
    assert_same(state.content, content_of(state.content["step"]))


@pytest.mark.full
def test_a_damaged_checkpoint_of_any_experiment_is_refused(
    every_experiment, options_of, tmp_path
):
    options = [*options_of(every_experiment), f"runs_dir={tmp_path}"]
    small = ["budget.agent_steps=400", "budget.total_steps=1500"]
    run = run_experiment(load_experiment([*options, *small]))
    newest = max((run / "checkpoints").iterdir())
    identity = Checkpoint.manifest(newest)["metadata"]
    alone = tmp_path / "alone"
    alone.mkdir()
    whole = bytearray(newest.read_bytes())

    def read(content):
        (alone / newest.name).write_bytes(content)
        state, refusal = State(), newest.name
        try:
            checkpoints_of(alone, state, identity).load_latest()
        except CheckpointError as error:
            refusal = str(error)
        assert newest.name in refusal
        assert state.restored == (state.content is not None)
        return state.content

    expected = read(whole)
    assert expected["loop"]["collected_frames"] >= 0
    choose, refused, same = random.Random(every_experiment), 0, 0
    for number in range(300):
        damaged, at = bytearray(whole), choose.randrange(len(whole))
        if number % 3 == 0:
            del damaged[at:]
        else:
            damaged[at] ^= 1 << choose.randrange(8)
        found = read(damaged)
        refused += found is None
        if found is not None:
            # The time of writing in the archive, which means nothing.
            assert number % 3, "what was cut off is missing"
            assert_same(found, expected)
            same += 1
    print(f"{every_experiment}: of 300 damaged checkpoints {refused} refused, {same} same")
    assert refused > 250


@pytest.mark.parametrize(
    ("identity", "message"),
    [
        ({**IDENTITY, "seed": 1}, "seed is 0, expected 1"),
        (
            {**IDENTITY, "configuration": "89ef4567"},
            "configuration is '0123abcd', expected '89ef4567'",
        ),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(identity, message, saved):
    state = State()
    with pytest.raises(CheckpointError, match=message) as refused:
        checkpoints_of(saved, state, identity).load_latest()
    assert str(saved) in str(refused.value)
    assert state.restored == 0


def test_what_is_refused_is_named(saved, caplog):
    newest = saved / "checkpoint-000000000020.torchrl"
    newest.write_bytes(b"nothing")
    assert checkpoints_of(saved, State()).load_latest()
    assert newest.name in caplog.text


def test_a_full_disk_leaves_the_checkpoints_before(saved, monkeypatch):
    write = Path.write_bytes

    def write_half(path, content):
        write(path, content[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    before = {path.name: path.read_bytes() for path in saved.iterdir()}
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", write_half)
        with pytest.raises(OSError, match="No space left"):
            checkpoints_of(saved, State(content_of(30))).save(30)
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before


def test_what_a_killed_process_left_unfinished_is_removed(saved):
    (saved / "..checkpoint-30.torchrl.stage-1").mkdir()
    (saved / "..checkpoint-30.torchrl.stage-1" / "state").write_text("half")
    (saved / ".checkpoint-000000000030.torchrl").write_text("half")
    state = State()
    assert checkpoints_of(saved, state).load_latest()
    assert_same(state.content, content_of(20))
    assert len(list(saved.iterdir())) == 2


def test_what_cannot_be_saved_is_named(tmp_path):
    with pytest.raises(TypeError, match=r"set \{1\} cannot be saved"):
        checkpoints_of(tmp_path, State({"a": {1}})).save(1)
    assert not list(tmp_path.iterdir())


def test_code_in_a_crafted_checkpoint_is_not_run(bomb_for, tmp_path):
    struck = tmp_path / "struck"
    name = "checkpoint-000000000001.torchrl"
    crafted = tmp_path / "crafted" / name
    theirs = Checkpoint().register(
        "training",
        State({"a": torch.ones(2)}),
        adapter=StateDictCheckpointAdapter("archive"),
    )
    theirs.save(crafted, metadata=IDENTITY)
    (payload,) = crafted.rglob("*.tdz")
    payload.unlink()
    TensorDict(code=NonTensorData(bomb_for(struck)), tensor_00000000=torch.ones(2)).save(
        payload, archive=True
    )
    # Making it copies the bomb, which sets it off.
    struck.unlink(missing_ok=True)
    (tmp_path / "checkpoints").mkdir()
    with zipfile.ZipFile(tmp_path / "checkpoints" / name, "w") as archive:
        for file in crafted.rglob("*"):
            archive.write(file, file.relative_to(crafted))
    state = State()
    with pytest.raises(CheckpointError, match="adapter"):
        checkpoints_of(tmp_path / "checkpoints", state).load_latest()
    assert state.restored == 0
    assert not struck.exists()
    # It would have been, by the adapter that we do not use.
    with pytest.warns(FutureWarning, match="pickle"):
        theirs.load(crafted)
    assert struck.exists()


@pytest.mark.parametrize(
    "outline",
    [
        '{"dict": [["a", {"tensor": "7"}]]}',
        '{"run": "code"}',
        '{"dict": 3}',
        "[1, 2]",
        '{"dict": [], "list": []}',
        "not json",
    ],
)
def test_a_crafted_outline_is_refused(outline, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(state_file.json, "dumps", lambda *a, **k: outline)
        checkpoint.SafetensorsAdapter().save(
            State({"a": torch.ones(2)}), tmp_path, args=(), kwargs={}
        )
    state = State()
    with pytest.raises(CheckpointError, match="damaged"):
        checkpoint.SafetensorsAdapter().load(
            state, tmp_path, map_location=None, tensor_load_kwargs={}, args=(), kwargs={}
        )
    assert state.restored == 0


# What is refused, and what is kept


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def damage(path):
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize("keep", [1, 2])
def test_a_damaged_newest_checkpoint_displaces_no_good_one(keep, tmp_path):
    state = State(content_of(10))
    first = Checkpoints(tmp_path, state, IDENTITY, keep=9)
    for step in (10, 20, 90):
        state.content = content_of(step)
        newest = first.save(step)
    damage(newest)
    state = State()
    checkpoints = Checkpoints(tmp_path, state, IDENTITY, keep=keep)
    assert checkpoints.load_latest()
    assert state.content["step"] == 20
    for step in (30, 40):
        state.content = content_of(step)
        assert checkpoints.save(step).exists(), "what was just saved is there"
    expected = [f"checkpoint-{step:012d}.torchrl" for step in (30, 40)[-keep:]]
    assert names_in(tmp_path) == [*expected, f"refused-{newest.name}"]
    again = State()
    assert checkpoints_of(tmp_path, again).load_latest()
    assert again.content["step"] == 40


def test_what_is_just_saved_stays_though_there_are_later_ones(tmp_path):
    """As when somebody puts them there while a run goes on."""
    state = State(content_of(1))
    checkpoints = Checkpoints(tmp_path, state, IDENTITY, keep=1)
    for step in (80, 90):
        (tmp_path / f"checkpoint-{step:012d}.torchrl").write_text("nothing")
    for step in (10, 20):
        assert checkpoints.save(step).exists()
    assert len(names_in(tmp_path)) == 3


def test_those_that_are_refused_twice_are_all_kept(tmp_path):
    for step in (10, 20, 20):
        state = State(content_of(step))
        checkpoints = Checkpoints(tmp_path, state, IDENTITY, keep=9)
        newest = checkpoints.save(step)
        if step == 20:
            newest.write_text("nothing")
            assert checkpoints.load_latest()
    name = "refused-checkpoint-000000000020.torchrl"
    assert names_in(tmp_path)[1:] == [name, f"{name}.1"]


def test_where_none_can_be_used_all_stay_as_they_are(saved):
    for path in saved.iterdir():
        damage(path)
    before = names_in(saved)
    for _ in range(2):
        with pytest.raises(CheckpointError, match="no checkpoint"):
            checkpoints_of(saved, State()).load_latest()
        assert names_in(saved) == before


# What the machine is to blame for

NOT_DAMAGE = {
    "no room": OSError(errno.ENOSPC, "No space left on device"),
    "no answer": OSError(errno.EIO, "Input/output error"),
    "no memory": MemoryError(),
    "no memory for torch": RuntimeError("DefaultCPUAllocator: can't allocate memory"),
}


@pytest.mark.parametrize(
    ("kind", "when"),
    [
        *((kind, "restoring") for kind in NOT_DAMAGE),
        *((kind, "reading") for kind in NOT_DAMAGE if kind != "no memory for torch"),
    ],
)
def test_what_the_machine_is_to_blame_for_is_no_damage(kind, when, saved, monkeypatch):
    before = {path.name: path.read_bytes() for path in saved.iterdir()}

    def fail(*args):
        raise NOT_DAMAGE[kind]

    state = State()
    with monkeypatch.context() as patch:
        if when == "reading":
            patch.setattr(checkpoint_file, "state_of", fail)
        else:
            patch.setattr(state, "load_state_dict", fail)
        with pytest.raises((OSError, MemoryError)) as told:
            checkpoints_of(saved, state).load_latest()
    assert "damaged" not in str(told.value)
    if when == "reading":
        assert "checkpoint-000000000020" in str(told.value)
    assert {path.name: path.read_bytes() for path in saved.iterdir()} == before
    assert checkpoints_of(saved, state).load_latest()
    assert state.content["step"] == 20


def test_nothing_is_unpacked_to_a_disk(saved, monkeypatch, tmp_path):
    """A folder for temporary files that is missing or full does no harm."""
    nowhere = str(tmp_path / "nowhere")
    monkeypatch.setenv("TMPDIR", nowhere)
    monkeypatch.setattr("tempfile.tempdir", nowhere)
    state = State()
    assert checkpoints_of(saved, state).load_latest()
    assert state.content["step"] == 20


# Crafted files


def zip_bomb(path):
    """Small files that say of themselves that they are large."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("manifest.json", "components/0000-training/state.safetensors"):
            with archive.open(name, "w", force_zip64=True) as file:
                for _ in range(256):
                    file.write(bytes(2**20))


def bomb_behind_a_manifest(path):
    record = {"adapter": "gdrl_torchrl.safetensors", "path": "components/0000-training"}
    manifest = {"metadata": IDENTITY, "components": {"training": record}}
    zip_bomb(path)
    with zipfile.ZipFile(path, "a") as archive, contextlib.suppress(UserWarning):
        archive.writestr("manifest.json", json.dumps(manifest))


def sparse(path):
    path.touch()
    os.truncate(path, 6 * 2**30)


def sparse_with_a_long_list(path):
    """An archive whose list of members is said to fill the file."""
    size = 6 * 2**30
    end = b"PK\x05\x06" + bytes(4) + b"\1\0\1\0" + (2**32 - 2).to_bytes(4, "little")
    sparse(path)
    with path.open("r+b") as file:
        file.seek(size - 22)
        file.write(end + (0).to_bytes(4, "little") + bytes(2))


def state_that_says_it_is_large(path):
    with zipfile.ZipFile(path, "w") as archive:
        record = {"adapter": "gdrl_torchrl.safetensors", "path": "x"}
        manifest = {"metadata": IDENTITY, "components": {"training": record}}
        archive.writestr("manifest.json", json.dumps(manifest))
        header = json.dumps(
            {"0": {"dtype": "F64", "shape": [2**33], "data_offsets": [0, 2**36]}}
        ).encode()
        archive.writestr("x/state.safetensors", len(header).to_bytes(8, "little") + header)


CRAFTED = {
    "pipe": os.mkfifo,
    "folder": os.mkdir,
    "zip bomb": zip_bomb,
    "bomb behind a manifest": bomb_behind_a_manifest,
    "sparse": sparse,
    "sparse with a long list": sparse_with_a_long_list,
    "a large state": state_that_says_it_is_large,
}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("kind", CRAFTED)
def test_a_crafted_checkpoint_takes_neither_memory_nor_time(kind, saved):
    crafted = saved / "checkpoint-000000000099.torchrl"
    CRAFTED[kind](crafted)
    state = State()
    tracemalloc.start()
    try:
        assert checkpoints_of(saved, state).load_latest()
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert state.content["step"] == 20
    assert most < 64 * 2**20
    assert f"refused-{crafted.name}" in names_in(saved)


def test_a_checkpoint_larger_than_what_is_free_is_refused_before_it_is_read(
    saved, monkeypatch
):
    monkeypatch.setattr(checkpoint_file, "_free_memory", lambda: 1000)
    with pytest.raises(MemoryError, match=r"checkpoint-000000000020.*are free"):
        checkpoints_of(saved, State()).load_latest()
    assert len(names_in(saved)) == 2
