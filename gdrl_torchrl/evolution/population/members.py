"""Members that act alone, and whether a batch of them gives the same actions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_torchrl.private_copy import digest, fingerprint, private_copy

Reason = str
"""Why members must act one by one; empty if they may act as a batch."""
Outputs = dict[Any, torch.Tensor]
_ROWS, _MEMBERS = 3, 2
"""Rows and members in a comparison."""
_CLOSE = 1e-4
"""By this share of the largest number a batch may differ from a row: rounding."""
_LONGEST_REASON = 160


def split_actor(
    actor: TensorDictModuleBase,
) -> tuple[TensorDictModuleBase, list[TensorDictModuleBase]]:
    """Split an actor after its last part with parameters: the first parts, and the rest."""
    if not isinstance(actor, TensorDictSequential):
        return actor, []
    parts: list[Any] = list(actor.module)
    owners = [i for i, part in enumerate(parts) if any(True for _ in part.parameters())]
    if not owners:
        raise ValueError(f"{type(actor).__name__} has no parameters")
    cut = owners[-1] + 1
    # Names remain those of the whole actor: module.0, module.1, ...
    return TensorDictSequential(*parts[:cut]), parts[cut:]


@torch.no_grad()
def make_members(actor: TensorDictModuleBase, params: TensorDictBase) -> list[Any]:
    """A copy of an actor for each of ``P`` members.

    Args:
        actor: The actor.
        params: All its parameters and buffers ``[P]``, by dotted name.
    """
    members = []
    for weights in params.unbind(0):
        member = private_copy(actor)
        for name, tensor in (*member.named_parameters(), *member.named_buffers()):
            tensor.copy_(weights[name])
        members.append(member)
    return members


def act_on(
    rows: TensorDictBase, outputs: Outputs, heads: Iterable[Any], action_key: str
) -> TensorDictBase:
    """Let heads choose an action from the outputs of a network.

    Args:
        rows: What the actor read, ``[B]``; outputs are added to it.
        outputs: What its network wrote, ``[B, ...]``.
        heads: The rest of the actor.
        action_key: Where the heads write the action.

    Returns:
        The rows, with ``policy_is_finite`` ``[B]``: whether outputs and action are
        numbers. NaN and infinity are replaced by a neutral value.
    """
    finite = torch.ones(rows.batch_size, dtype=torch.bool)
    for key, value in outputs.items():
        # A finite sum means that all numbers are finite; only if it is not, look closer.
        if value.dtype.is_floating_point and not torch.isfinite(value.sum()):
            strange = _strange(value)
            finite &= ~strange.reshape(len(finite), -1).any(dim=1)
            # With a neutral value heads do not raise; the row is marked instead.
            value = value.masked_fill(strange, 1.0 if key == "scale" else 0.0)
        rows.set(key, value)
    for head in heads:
        rows = head(rows)
    action = rows.get(action_key, None)
    if action is not None and action.dtype.is_floating_point:
        strange = ~torch.isfinite(action)
        if bool(strange.any()):
            finite &= ~strange.reshape(len(finite), -1).any(dim=1)
            rows.set(action_key, action.masked_fill(strange, 0.0))
    return rows.set("policy_is_finite", finite)


def _strange(value: torch.Tensor) -> torch.Tensor:
    """Mask of numbers that are errors of the network.

    Minus infinity is none, since it forbids an action, unless all of a row is forbidden.
    """
    forbidden = torch.isneginf(value)
    if value.ndim > 1:
        forbidden = forbidden & forbidden.all(dim=-1, keepdim=True)
    return torch.isnan(value) | torch.isposinf(value) | forbidden


@torch.no_grad()
def why_one_by_one(
    actor: TensorDictModuleBase,
    vmapped: Callable[[TensorDictBase, TensorDictBase], TensorDictBase],
    params: TensorDictBase,
    inputs: TensorDictBase,
) -> Reason:
    """Compare members as a batch with members that act alone.

    Args:
        actor: The actor; it is copied, not called.
        vmapped: Its part with parameters, of parameters ``[P]`` and inputs ``[P, S]``.
        params: All parameters and buffers of members ``[P]``, by dotted name.
        inputs: Inputs of the members, ``[P, S]``.

    Returns:
        Why they must act one by one; empty if they may act as a batch.

    Raises:
        Exception: What the actor raises when it acts alone.
    """
    params, shown = few_members(params, inputs)
    with torch.random.fork_rng(devices=[]):
        members = make_members(actor, params)
        first = [_act(member, rows) for member, rows in zip(members, shown, strict=True)]
        states = [_state(member) for member in members]
        again = [_act(member, rows) for member, rows in zip(members, shown, strict=True)]
        if states != [_state(member) for member in members]:
            return "it keeps a state from one call to the next"
        if not all(map(_are_equal, first, again)):
            return "it draws random numbers"
        if shown.shape[1] > 1 and not _rows_are_apart(members[0], shown[0], first[0]):
            return "its outputs for a row depend on the other rows"
        _, heads = split_actor(private_copy(actor))
        try:
            batch = vmapped(params, shown)
            rows = shown.reshape(-1).update(batch.reshape(-1))
            final = finished(rows, heads, actor.out_keys)
        except Exception as error:  # whatever torch.vmap refuses
            said = str(error).strip().partition("\n")[0]
            return f"torch.vmap refuses it ({said[:_LONGEST_REASON]})"
    count = shown.shape[1]
    for number, expected in enumerate(first):
        rows = slice(number * count, (number + 1) * count)
        if not _are_close({key: final[key][rows] for key in expected}, expected):
            return "as a batch its outputs are others"
    return ""


def _act(member: Any, rows: TensorDictBase) -> Outputs:
    """What a member writes for rows ``[S]``, its heads without exploration."""
    prefix, heads = split_actor(member)
    rows = rows.clone()
    written = prefix(rows.clone()).select(*prefix.out_keys, strict=False)
    return finished(rows.update(written), heads, member.out_keys)


def few_members(
    params: TensorDictBase, inputs: TensorDictBase
) -> tuple[TensorDictBase, TensorDictBase]:
    """Parameters and inputs of few members, few rows of each, for comparisons.

    Args:
        params: Parameters and buffers of members ``[P]``. With weights that are NaN or
            infinite nothing could be compared: members without them come first, and such
            weights are replaced.
        inputs: Inputs of the members, ``[P, S]``.
    """
    chosen = _finite_first(params)[:_MEMBERS]
    own: Any = params[chosen]
    shown: Any = inputs[chosen][:, :_ROWS]
    return own.apply(lambda leaf: leaf.nan_to_num(0.0, 0.0, 0.0)), shown


def finished(rows: TensorDictBase, heads: Iterable[Any], keys: Iterable[Any]) -> Outputs:
    """What heads write for rows with the outputs of a network, without exploration."""
    # Random draws of heads differ between rows and batch: compare without exploration.
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for head in heads:
            rows = head(rows)
    found = {key: rows.get(key, None) for key in keys}
    return {key: value for key, value in found.items() if value is not None}


def _rows_are_apart(member: Any, rows: TensorDictBase, expected: Outputs) -> bool:
    try:
        alone = [_act(member, rows[i : i + 1]) for i in range(len(rows))]
    except Exception:  # such as batch normalisation's error for one row
        return False
    together = {key: torch.cat([one[key] for one in alone]) for key in expected}
    return _are_close(together, expected)


def _state(member: Any) -> tuple[Any, ...]:
    return fingerprint(member), *(digest(buffer) for buffer in member.buffers())


def _finite_first(params: TensorDictBase) -> torch.Tensor:
    """Indices of all members, those with finite parameters first."""
    finite = torch.ones(len(params), dtype=torch.bool)
    for value in params.values():
        if value.dtype.is_floating_point:
            finite &= torch.isfinite(value).reshape(len(params), -1).all(dim=1)
    return finite.to(torch.int64).argsort(descending=True, stable=True)


def _are_equal(one: Outputs, other: Outputs) -> bool:
    return all(torch.equal(_bare(one[key]), _bare(other[key])) for key in one)


def _are_close(one: Mapping[Any, torch.Tensor], other: Outputs) -> bool:
    """Whether numbers are equal but for rounding; integers count if there are no others."""
    numbers = [key for key, value in other.items() if value.dtype.is_floating_point]
    return all(is_close(one[key], other[key]) for key in numbers or other)


def is_close(one: torch.Tensor, other: torch.Tensor) -> bool:
    """Whether numbers are equal but for rounding, and integers equal."""
    if not other.dtype.is_floating_point:
        return torch.equal(one, other)
    finite = other[torch.isfinite(other)].abs()
    size = float(finite.max()) if len(finite) else 0.0
    return torch.allclose(one, other, rtol=_CLOSE, atol=_CLOSE * size, equal_nan=True)


def _bare(value: torch.Tensor) -> torch.Tensor:
    return value.nan_to_num() if value.dtype.is_floating_point else value
