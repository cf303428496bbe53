"""Checkpoints that somebody made to do harm: code, and sizes that are only said."""

from __future__ import annotations

import contextlib
import json
import os
import tracemalloc
import zipfile

import pytest
import torch
from tensordict import NonTensorData, TensorDict
from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter

from gdrl_torchrl.files import checkpoint as checkpoint_file
from gdrl_torchrl.files import state as state_file
from gdrl_torchrl.runs import checkpoint
from tests.marks import full_but
from tests.reliability.files.states import IDENTITY, State, checkpoints_of, names_in


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
@pytest.mark.parametrize("kind", full_but(CRAFTED.keys() - {"zip bomb"}, CRAFTED))
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
