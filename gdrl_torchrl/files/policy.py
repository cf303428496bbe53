"""The policy of a run as a file, with what it needs of a task."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import load, save
from torch import nn

from gdrl_tasks import NavigationTask
from gdrl_torchrl.files.fields import DIGEST, read_object
from gdrl_torchrl.files.safe_files import own_folder, read_content, written_aside

POLICY_FILE = "policy.safetensors"


CONTRACT_FILE = "contract.json"


def params_sha256(module: nn.Module) -> str:
    """Digest of a module's parameters and buffers, by name."""
    return _digest(module.state_dict())


def _digest(state: Mapping[str, torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(state.items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def save_policy(
    folder: Path, actor: nn.Module, task: NavigationTask, algorithm: str
) -> None:
    """Write a policy's weights (safetensors) and what is needed to use them.

    A reader never sees half a file; until both are there, their digests differ.

    Args:
        folder: Where to.
        actor: The policy.
        task: What it was trained on.
        algorithm: What by: the label of tables and figures.

    Raises:
        OSError: If a file cannot be written; what was there before is whole.
    """
    own_folder(folder)
    # Copies: the format refuses buffers that share memory, as TorchRL's supports do.
    state = {name: value.clone() for name, value in actor.state_dict().items()}
    # Not by ``save_file``, whose errors do not say what the system said.
    _write(folder / POLICY_FILE, save(state))
    low, high = task.spec.observation_bounds
    contract = {
        "task": task.name,
        "algorithm": algorithm,
        "observation": {name: spec[0] for name, spec in task.spec.observation.items()},
        "observation_low": low.tolist(),
        "observation_high": high.tolist(),
        "observation_dtype": "float32",
        "action_size": task.spec.action_size,
        "is_discrete": task.spec.is_discrete,
        "control_interval_s": task.spec.control_interval_s,
        "params_sha256": params_sha256(actor),
    }
    _write(folder / CONTRACT_FILE, f"{json.dumps(contract, indent=2)}\n".encode())


def load_policy(folder: Path, actor: nn.Module, *, network: str = "the network") -> None:
    """Read weights of :func:`save_policy` into an actor of the same shape.

    No code of the file is run: it has none. After an error the actor is what it was.

    Args:
        folder: Where from.
        actor: What the weights are for.
        network: What errors call the actor, such as the file that it was made from: if
            the two differ, either may be damaged.

    Raises:
        ValueError: If the file is missing, damaged, of another network, holds numbers
            that are not finite, or is not what its contract, if there is one, says.
    """
    path, contract = folder / POLICY_FILE, folder / CONTRACT_FILE
    own = actor.state_dict()
    # The header takes some hundred bytes a tensor.
    most_bytes = 2**20 + 2 * sum(value.nbytes for value in own.values())
    try:
        state = load(read_content(path, most_bytes))
    # What a damaged file makes readers raise has no common type.
    except Exception as error:
        raise ValueError(f"{path} cannot be loaded: {error}") from error
    _check_state(state, own, path, network)
    if contract.exists():
        said = read_object(contract, {"params_sha256": DIGEST})["params_sha256"]
        if said != (found := _digest(state)):
            raise ValueError(
                f"{path} cannot be loaded: its params_sha256 is {found}, expected {said} "
                f"by {contract.name}"
            )
    actor.load_state_dict(state)


def _check_state(
    found: Mapping[str, torch.Tensor],
    expected: Mapping[str, torch.Tensor],
    path: Path,
    network: str,
) -> None:
    """Raise ValueError unless two states have the same names, types and shapes."""
    problem = f"{path} cannot be loaded: it"
    if missing := sorted(expected.keys() - found.keys()):
        raise ValueError(f"{problem} has no {missing}, which {network} has")
    if unknown := sorted(found.keys() - expected.keys()):
        raise ValueError(f"{problem} has {unknown}, which {network} has not")
    for name, its in found.items():
        own = expected[name]
        if (its.dtype, its.shape) != (own.dtype, own.shape):
            raise ValueError(
                f"{problem} has {name} of {its.dtype} {list(its.shape)}, {network} has "
                f"{own.dtype} {list(own.shape)}"
            )
        if not bool(torch.isfinite(its).all()):
            raise ValueError(f"{problem} has {name} with numbers that are not finite")


def _write(path: Path, content: bytes) -> None:
    with written_aside(path) as aside:
        aside.write_bytes(content)
