"""Policies that say themselves how many members of them act at once."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from gdrl_torchrl.evolution.population.members import few_members, finished, is_close
from gdrl_torchrl.fast.graph import Tensors

_logger = logging.getLogger(__name__)

Run = Callable[..., tuple[torch.Tensor, ...]]
"""Inputs ``[P, S, ...]``, one by one, to actions ``[P, S, ...]`` and numbers that are all
finite if what the members' networks wrote is: outputs, or sums of them."""


class Prepares(Protocol):
    """A policy with a fast form for many members that choose greedily.

    It is used instead of a graph where the policy reads one entry and explores nothing, if
    it gives the actions of the policy's modules when it is first used.
    """

    def prepared(self, params: TensorDictBase) -> Run | None:
        """Make a function of observations, in which all that depends on weights is done.

        Args:
            params: All parameters and buffers of ``P`` members, ``[P]``, nested by name.

        Returns:
            A function of observations ``[P, S, ...]`` that gives actions ``[P, S, ...]``
            and the outputs of the network ``[P, S, ...]``, which must not be finite where
            an action is not to be trusted; None where there is no fast form.
        """
        ...


def acts_as_its_modules(
    actor: Any,
    vmapped: Callable[[TensorDictBase, TensorDictBase], TensorDictBase],
    heads: Iterable[Any],
    params: TensorDictBase,
    inputs: TensorDictBase,
    action_key: NestedKey,
) -> bool:
    """Whether what a policy has prepared gives the actions of its modules, on a few rows.

    Args:
        actor: The policy. One that prepares nothing gives no such actions.
        vmapped: Its part with parameters, of parameters ``[P]`` and inputs ``[P, S]``.
        heads: The rest of it.
        params: Parameters and buffers of members ``[P]``, by dotted name.
        inputs: The one entry that it reads, ``[P, S]``.
        action_key: Where it writes the action.
    """
    params, shown = few_members(params, inputs)
    [observation] = shown.values(include_nested=True, leaves_only=True)
    run = prepared_run(actor, params, parts=1, run_all=map)
    if run is None:
        return False
    action, _ = run(observation)
    rows = shown.reshape(-1)
    rows = rows.update(vmapped(params, shown).reshape(-1))
    expected = finished(rows, heads, [action_key])[action_key]
    flat = action.flatten(0, 1)
    if flat.shape == expected.shape and is_close(flat, expected):
        return True
    _logger.warning("%s acts otherwise than it has prepared", type(actor).__name__)
    return False


def prepared_run(
    actor: Any, params: TensorDictBase, *, parts: int, run_all: Any
) -> Run | None:
    """A function that gives actions and outputs as the policy says, or None.

    Args:
        actor: The policy; it may be a :class:`Prepares`.
        params: Parameters and buffers of members ``[P]``, by dotted name.
        parts: Number of parts that members are split into.
        run_all: Runs the parts, see :meth:`~.actor.PopulationActor.bind`.
    """
    # Of its class: tensordict's modules lend attributes of what they wrap.
    if not hasattr(type(actor), "prepared"):
        return None
    length = -(-len(params) // parts)
    runs = [actor.prepared(part) for part in params.unflatten_keys(".").split(length)]
    return None if None in runs else in_parts(runs, length, run_all)


def in_parts(runs: list[Run], length: int, run_all: Any) -> Run:
    """Join functions of ``length`` members each to one of all members.

    Args:
        runs: The functions.
        length: Number of members of each, but for the last one's.
        run_all: ``map``, or ``map`` of a pool of threads.
    """
    if len(runs) == 1:
        return runs[0]

    def run_part(run: Run, part: Tensors) -> tuple[torch.Tensor, torch.Tensor]:
        action, outputs = run(*part)
        return action, outputs.sum()

    def run(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        split = zip(*(value.split(length) for value in values), strict=True)
        actions, sums = zip(*run_all(run_part, runs, split), strict=True)
        return torch.cat(actions), torch.stack(sums)

    return run
