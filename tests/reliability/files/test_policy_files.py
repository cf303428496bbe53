"""Policies on disk that are not those that were saved."""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load, save

from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.files.policy import load_policy, save_policy
from tests.reliability.files.readers import (
    CONTRACT,
    POLICY,
    actor,
    attempt,
    read_policy,
    replaced,
)


def with_weights(run, change):
    """The policy's file with other weights."""
    state = load((run / POLICY).read_bytes())
    change(state, min(state))
    return save(state)


def spoil(value):
    def change(state, name):
        state[name].view(-1)[0] = value

    return change


def rename(state, name):
    state["another"] = state.pop(name)


POLICIES = {
    "other weight": (spoil(0.125), "params_sha256"),
    "nan": (spoil(float("nan")), "not finite"),
    "infinite": (spoil(float("inf")), "not finite"),
    "double": (lambda s, n: s.update({n: s[n].double()}), "float64"),
    "whole": (lambda s, n: s.update({n: s[n].int()}), "int32"),
    "flat": (lambda s, n: s.update({n: s[n].reshape(1, -1)}), r"\[1, "),
    "renamed": (rename, "has no"),
    "further": (lambda s, n: s.update(more=torch.ones(1)), "more"),
    "none": (lambda s, n: s.clear(), "has no"),
}


@pytest.mark.parametrize("case", POLICIES)
def test_a_policy_that_is_another_is_refused(case, run):
    change, said = POLICIES[case]
    said = rf"policy\.safetensors.*{said}"
    with (
        replaced(run / POLICY, with_weights(run, change)),
        pytest.raises(ValueError, match=said),
    ):
        read_policy(run)


@pytest.mark.parametrize("kind", ["F4", "F8_E8M0", "U64", "XYZ"])
def test_weights_of_an_odd_type_are_refused(kind, run):
    size = 1 if kind != "U64" else 16
    entry = {"dtype": kind, "shape": [2], "data_offsets": [0, size]}
    header = json.dumps({"weight": entry}).encode()
    with replaced(run / POLICY, len(header).to_bytes(8, "little") + header + bytes(size)):
        assert attempt("policy", run) is None


def test_a_policy_without_a_contract_is_read_but_not_with_nan(run):
    expected = read_policy(run)
    with replaced(run / CONTRACT, None):
        assert read_policy(run) == expected
        with replaced(run / POLICY, with_weights(run, spoil(float("nan")))):
            assert attempt("policy", run) is None


def test_a_full_disk_leaves_the_policy_before(run, config, tmp_path, monkeypatch):
    folder = shutil.copytree(run / "final", tmp_path / "final")
    write = Path.write_bytes

    def write_half(path, content):
        write(path, content[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", write_half)
        with pytest.raises(OSError, match="No space left"):
            save_policy(folder, actor(), make_task_of(config), config.algorithm_label)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_policy_with_the_contract_of_the_one_before_is_refused(run, config):
    content = (run / CONTRACT).read_bytes()
    with replaced(run / POLICY, (run / POLICY).read_bytes()):
        read_policy(run)
        with torch.no_grad():
            next(actor().parameters()).add_(1.0)
        save_policy(run / "final", actor(), make_task_of(config), config.algorithm_label)
        # The process died before it wrote the second file.
        (run / CONTRACT).write_bytes(content)
        with pytest.raises(ValueError, match=r"expected \w{64} by contract\.json"):
            load_policy(run / "final", actor())
    read_policy(run)
