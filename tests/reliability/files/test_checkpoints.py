"""Checkpoints: what comes back, of damaged ones too, and what a failed saving leaves."""

from __future__ import annotations

import errno
import random
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.checkpoint import Checkpoint, CheckpointError

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.runs.run import run_experiment
from tests.reliability.files.states import State, assert_same, checkpoints_of, content_of

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
