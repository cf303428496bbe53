"""Graphs of the members' actions, one for each shape of their inputs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import exploration_type

from gdrl_torchrl.evolution.population.prepared import Run, in_parts
from gdrl_torchrl.fast.graph import Tensors, TracedFunction, trace


class _Bound(NamedTuple):
    """A graph with the weights of some members."""

    run: Run
    is_pure: bool


class MemberGraphs:
    """Traces members when they first act on rows of a shape.

    Args:
        vmapped: The part of an actor with parameters, of parameters ``[P]`` and inputs
            ``[P, S]``.
        out_keys: What that part writes.
        heads: The rest of the actor.
        action_key: Where the actor writes the action.

    Attributes:
        graphs: Graphs by all that they depend on; None where tracing failed.
    """

    def __init__(
        self,
        vmapped: Callable[[TensorDictBase, TensorDictBase], TensorDictBase],
        out_keys: Sequence[Any],
        heads: Sequence[Any],
        action_key: str,
    ) -> None:
        self._vmapped, self._out_keys = vmapped, list(out_keys)
        self._heads, self._action_key = heads, action_key
        self.graphs: dict[Any, TracedFunction | None] = {}
        self._bounds: dict[Any, _Bound] = {}

    def unbind(self) -> None:
        """Forget the weights that graphs are bound to, before other members are used."""
        self._bounds.clear()

    def outputs(
        self, params: TensorDictBase, inputs: TensorDictBase
    ) -> tuple[torch.Tensor, ...] | None:
        """What members ``[P]`` write for inputs ``[P, S]``; None without a graph."""
        bound = self._bound(params, inputs, slice(None), is_whole=False)
        return None if bound is None else bound.run(*leaves_of(inputs).values())

    def run_of(
        self, params: TensorDictBase, inputs: TensorDictBase, parts: int, run_all: Any
    ) -> Run | None:
        """A function that gives actions and sums of each row's outputs, or None.

        Arguments as in :meth:`~.actor.PopulationActor.bind`.
        """
        length = -(-len(inputs) // parts)
        begins = range(0, len(inputs), length)
        bound: list[_Bound] = []
        for begin, part in zip(begins, inputs.split(length), strict=True):
            members = slice(begin, begin + length)
            one = self._bound(params, part, members, is_whole=True)
            if one is None:
                return None
            bound.append(one)
        # Graphs that draw random numbers or write must not run side by side.
        if not all(each.is_pure for each in bound):
            run_all = map
        return in_parts([each.run for each in bound], length, run_all)

    def _bound(
        self,
        params: TensorDictBase,
        inputs: TensorDictBase,
        members: slice,
        *,
        is_whole: bool,
    ) -> _Bound | None:
        """The graph for inputs ``[P, S]`` of some members; None if there is none."""
        # All that the operations depend on, except numbers and the modules' state.
        kinds = tuple((name, x.shape, x.dtype) for name, x in leaves_of(inputs).items())
        key = (kinds, exploration_type(), is_whole)
        if key not in self.graphs:
            run = self._run_whole if is_whole else self._run_prefix
            self.graphs[key] = _traced(run, params[members], inputs)
        graph = self.graphs[key]
        if graph is None:
            return None
        bound = (*key, members.start)
        if bound not in self._bounds:
            weights = leaves_of(params[members]).values()
            self._bounds[bound] = _Bound(graph.bind(list(weights)), graph.is_pure)
        return self._bounds[bound]

    def _run_prefix(
        self, params: TensorDictBase, inputs: TensorDictBase
    ) -> list[torch.Tensor]:
        out = self._vmapped(params, inputs)
        return [out.get(key) for key in self._out_keys]

    def _run_whole(
        self, params: TensorDictBase, inputs: TensorDictBase
    ) -> list[torch.Tensor]:
        size = inputs.batch_size
        out = self._vmapped(params, inputs).reshape(-1)
        sums = [
            value.sum(dim=tuple(range(1, value.ndim))) if value.ndim > 1 else value
            for value in leaves_of(out).values()
            if value.dtype.is_floating_point
        ]
        # A sum is finite if all numbers are, unless it overflows. So callers look at the
        # numbers themselves where it is not.
        total = torch.stack(sums).sum(0) if len(sums) > 1 else sums[0]
        rows = inputs.clone().reshape(-1).update(out)
        for head in self._heads:
            rows = head(rows)
        return [rows[self._action_key].unflatten(0, size), total]


def _traced(run: Any, params: Any, inputs: TensorDictBase) -> TracedFunction | None:
    """A function of parameters and inputs as a graph, or None if it is not one."""
    weights, count = leaves_of(params), params.batch_size
    shown, size = leaves_of(inputs), inputs.batch_size

    def flat(constants: Tensors, values: Tensors) -> Tensors:
        return run(nested(weights, constants, count), nested(shown, values, size))

    return trace(flat, list(weights.values()), list(shown.values()))


def leaves_of(values: TensorDictBase) -> dict[Any, torch.Tensor]:
    """Leaves by name, nested ones by a tuple of names."""
    return dict(values.items(include_nested=True, leaves_only=True))


def nested(names: Iterable[Any], values: Tensors, batch_size: torch.Size) -> TensorDictBase:
    """The opposite of :func:`leaves_of`."""
    whole = TensorDict(batch_size=batch_size)
    for name, value in zip(names, values, strict=True):
        whole.set(name, value)
    return whole
