"""Checkpoints that are refused: what is kept then, and what is no damage."""

from __future__ import annotations

import errno

import pytest
from torchrl.checkpoint import CheckpointError

from gdrl_torchrl.files import checkpoint as checkpoint_file
from gdrl_torchrl.runs.checkpoint import Checkpoints
from tests.reliability.files.states import (
    IDENTITY,
    State,
    checkpoints_of,
    content_of,
    names_in,
)


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
