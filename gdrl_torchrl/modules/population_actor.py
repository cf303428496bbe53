"""Many members of one actor's family, run as one batch."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch.func import functional_call
from torchrl.envs.utils import exploration_type

from gdrl_torchrl.evolution.genome import fitting_leaves
from gdrl_torchrl.modules.graph import Tensors, TracedFunction, trace
from gdrl_torchrl.modules.members import (
    Reason,
    act_on,
    make_members,
    split_actor,
    why_one_by_one,
)
from gdrl_torchrl.modules.private_copy import fingerprint, private_copy

_logger = logging.getLogger(__name__)


class PopulationActor:
    """Run ``P`` members of an actor on ``[P * S]`` rows, member by member.

    Members are copies of the actor with weights of their own; the actor itself is only
    read. Its modes, attributes and buffers are taken over at every :meth:`load`.

    The part of the actor that owns parameters is vectorised over members; the heads
    that own none (distributions, argmax) run on all rows at once, so actors whose
    heads ``torch.vmap`` refuses work too. That part is traced once to a graph of tensor
    operations and run without Python's share of the work, which for small networks is
    most of it. The graph is used only if it gives the same numbers, bit for bit, as the
    vectorised modules on its first inputs; otherwise the modules are run.

    On its first inputs an actor is also compared with members that act alone. If it acts
    otherwise as a batch (recurrent layers that vmap refuses, batch statistics, random
    layers, a state in buffers or attributes), members act one by one, each a copy that
    keeps its own state from :meth:`load` on; the log says why.

    Args:
        actor: Any TorchRL actor without lazy layers: a tensordict module, or a
            sequence of them.
        trace: Whether to trace.
        action_key: Where the actor writes its action.

    Attributes:
        in_keys: What the actor reads.
        num_evolving: Weights of a member that come from its genome.
        reason: Why members act one by one, as found last; empty if they act as a batch.

    Raises:
        ValueError: If the actor has no parameters, or cannot be copied.

    Examples:
        >>> from gdrl_torchrl.evolution.genome import genome_of, stack_copies
        >>> from gdrl_torchrl.modules.actor import make_tanh_normal_actor
        >>> from torchrl.data import Bounded
        >>> actor = make_tanh_normal_actor(3, Bounded(-1, 1, shape=(2,)))
        >>> population = PopulationActor(actor)
        >>> population.load(stack_copies(genome_of(actor), 4))
        >>> rows = TensorDict(observation=torch.zeros(4 * 5, 3), batch_size=[20])
        >>> population(rows)["action"].shape
        torch.Size([20, 2])
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        *,
        trace: bool = True,
        action_key: str = "action",
    ) -> None:
        if not any(True for _ in actor.parameters()):
            raise ValueError(f"{type(actor).__name__} has no parameters")
        self.actor = actor
        self.trace = trace
        self.action_key = action_key
        self.in_keys = list(actor.in_keys)
        self.num_evolving = 0
        self.reason: Reason = ""
        self._fingerprint: bytes | None = None
        self._all: TensorDictBase | None = None
        self._params: TensorDictBase | None = None
        self._members: list[Any] | None = None
        self._copy_actor(None)

    def load(self, genomes: TensorDictBase) -> None:
        """Make members of genomes, and choose all of them.

        Args:
            genomes: Parameters ``[P]`` by nested name; those of the actor that are
                missing (and all buffers) are the actor's own, as they are now.

        Raises:
            ValueError: If a leaf is not one of the actor's parameters, or has another
                shape or type.
        """
        parameters = dict(self.actor.named_parameters())
        given = fitting_leaves(genomes, parameters, type(self.actor).__name__)
        now = fingerprint(self.actor)
        if now is None or now != self._fingerprint:
            self._copy_actor(now)
        size = genomes.batch_size
        own = parameters | dict(self.actor.named_buffers())
        weights = {
            name: value.detach().clone().expand(*size, *value.shape)
            for name, value in own.items()
            if name not in given
        }
        self._all = TensorDict(weights | given, batch_size=size)
        self.num_evolving = sum(value[0].numel() for value in given.values())
        self.choose(slice(None))

    def choose(self, members: Any) -> None:
        """Choose who acts: indices of loaded members, ``[K]``, each as often as given."""
        if self._all is None:
            raise RuntimeError("no members are loaded: call load(genomes) first")
        self._params = self._all[members]
        self._members = None
        self._loaded.clear()

    def unload(self) -> None:
        """Forget the members."""
        self._all = self._params = self._members = None
        self._loaded.clear()

    def acts_row_by_row(self, rows: TensorDictBase) -> bool:
        """Whether each row's action depends on that row and the weights alone.

        Args:
            rows: What members may be shown, ``[S]``, ``S`` >= 2.
        """
        params = self._chosen()
        inputs = rows.select(*self.in_keys).expand(len(params), *rows.batch_size)
        return self._is_vectorised(inputs)

    @torch.no_grad()
    def __call__(self, rows: TensorDictBase) -> TensorDictBase:
        """Act: rows ``[P * S]``, the members' rows one after another.

        Returns:
            ``rows`` with the actor's outputs and ``policy_is_finite`` ``[P * S]``. A row
            whose network output is not a number acts as if the output were 0, and is
            marked. Minus infinity is let through, as a mask of forbidden actions, where
            something else remains to be chosen.

        Raises:
            RuntimeError: If no members are loaded.
        """
        inputs = rows.select(*self.in_keys).reshape(len(self._chosen()), -1)
        if not self._is_vectorised(inputs):
            return self._one_by_one(rows, inputs)
        outputs = self._outputs(inputs.select(*self._prefix.in_keys))
        flat = {key: value.flatten(0, 1) for key, value in outputs.items()}
        return act_on(rows, flat, self._heads, self.action_key)

    @torch.no_grad()
    def bind(
        self, inputs: TensorDictBase, *, parts: int = 1, run_all: Any = map
    ) -> Callable[[Tensors], tuple[torch.Tensor, torch.Tensor]]:
        """The members' actions alone, heads traced too where that is possible.

        Args:
            inputs: What the actor may read, ``[P, S]``: any numbers will do.
            parts: Runs of members that act one after another, where there is a graph.
            run_all: As ``map``, or ``map`` of a pool of threads for them to act side by
                side. The actions are the same.

        Returns:
            A function of tensors as those of ``inputs``, in their order, ``[P, S, ...]``.
            It gives actions ``[P, S, ...]`` and the mask of rows whose network output
            was a number ``[P, S]``. Choosing other members ends its use.
        """
        run = None
        if self._is_vectorised(inputs):
            run = self._run_of(inputs, parts, run_all)
        names, size = _leaves(inputs), inputs.batch_size

        def act(values: Tensors) -> tuple[torch.Tensor, torch.Tensor]:
            if run is not None:
                action, finite = run(*values)
                if bool(finite.all()):
                    return action, finite
            rows = self(_nested(names, values, size).reshape(-1))
            return (
                rows[self.action_key].unflatten(0, size),
                rows["policy_is_finite"].unflatten(0, size),
            )

        return act

    def _copy_actor(self, now: bytes | None) -> None:
        """A new copy to run, for which nothing is known yet."""
        self._fingerprint = now
        self._actor = private_copy(self.actor)
        self._prefix, self._heads = split_actor(self._actor)
        self._graphs: dict[Any, TracedFunction | None] = {}
        self._loaded: dict[Any, _Bound] = {}
        self._reasons: dict[Any, Reason] = {}
        self._vmapped = torch.vmap(self._call, in_dims=(0, 0), randomness="different")

    def _chosen(self) -> TensorDictBase:
        if self._params is None:
            raise RuntimeError("no members are loaded: call load(genomes) first")
        return self._params

    def _is_vectorised(self, inputs: TensorDictBase) -> bool:
        """Whether members act as a batch as they would alone, by inputs ``[P, S]``."""
        kinds = tuple((name, x.shape[2:], x.dtype) for name, x in _leaves(inputs).items())
        key = (kinds, exploration_type(), min(inputs.shape[1], 2))
        if key not in self._reasons:
            params = self._chosen()
            reason = why_one_by_one(self._actor, self._vmapped, params, inputs)
            if reason is None:
                return True  # nothing was learned: ask again
            if reason:
                name = type(self.actor).__name__
                _logger.warning("members of %s act one by one: %s", name, reason)
            self._reasons[key] = reason
        self.reason = self._reasons[key]
        return not self.reason

    def _one_by_one(self, rows: TensorDictBase, inputs: TensorDictBase) -> TensorDictBase:
        if self._members is None:
            self._members = make_members(self._actor, self._chosen())
        acted: list[Any] = []
        for member, own in zip(self._members, inputs.unbind(0), strict=True):
            prefix, heads = split_actor(member)
            written = prefix(own.clone()).select(*prefix.out_keys, strict=False)
            acted.append(act_on(own.clone(), _leaves(written), heads, self.action_key))
        return rows.update(torch.cat(acted))

    def _outputs(self, inputs: TensorDictBase) -> dict[Any, torch.Tensor]:
        """Outputs ``[P, S, ...]`` of the members for inputs ``[P, S]``, by key."""
        bound = self._bound(inputs)
        if bound is None:
            return _leaves(self._vmapped(self._chosen(), inputs))
        outputs = bound.run(*_leaves(inputs).values())
        return dict(zip(self._prefix.out_keys, outputs, strict=True))

    def _run_of(self, inputs: TensorDictBase, parts: int, run_all: Any) -> Any:
        """A function that gives actions and whether they are numbers, or None."""
        length = -(-len(inputs) // parts)
        begins = range(0, len(inputs), length)
        bound: list[_Bound] = []
        for begin, part in zip(begins, inputs.split(length), strict=True):
            one = self._bound(part, slice(begin, begin + length), whole=True)
            if one is None:
                return None
            bound.append(one)
        runs = [each.run for each in bound]
        if len(runs) == 1:
            return runs[0]
        # What one draws or writes, another may not be in the middle of.
        if not all(each.is_pure for each in bound):
            run_all = map

        def run_parts(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
            split = zip(*(value.split(length) for value in values), strict=True)
            outputs = run_all(lambda run, part: run(*part), runs, split)
            return tuple(torch.cat(each) for each in zip(*outputs, strict=True))

        return run_parts

    def _bound(
        self,
        inputs: TensorDictBase,
        members: slice = slice(None),
        *,
        whole: bool = False,
    ) -> _Bound | None:
        """The graph for inputs ``[P, S]`` of some members; None if there is none."""
        # Without a fingerprint nobody knows what a graph would have outlived.
        if not self.trace or self._fingerprint is None:
            return None
        values = _leaves(inputs)
        # All that the operations depend on beside the numbers and the fingerprint.
        kinds = tuple((name, x.shape, x.dtype) for name, x in values.items())
        key = (kinds, exploration_type(), whole)
        if key not in self._graphs:
            run = self._run_whole if whole else self._run_prefix
            self._graphs[key] = self._traced(run, inputs, members)
        graph = self._graphs[key]
        if graph is None:
            return None
        loaded = (*key, members.start)
        if loaded not in self._loaded:
            leaves = _leaves(self._chosen()[members]).values()
            self._loaded[loaded] = _Bound(graph.bind(list(leaves)), graph.is_pure)
        return self._loaded[loaded]

    def _run_prefix(
        self, params: TensorDictBase, inputs: TensorDictBase
    ) -> list[torch.Tensor]:
        out = self._vmapped(params, inputs)
        return [out.get(key) for key in self._prefix.out_keys]

    def _run_whole(
        self, params: TensorDictBase, inputs: TensorDictBase
    ) -> list[torch.Tensor]:
        size = inputs.batch_size
        out = self._vmapped(params, inputs).reshape(-1)
        sums = [
            value.sum(dim=tuple(range(1, value.ndim))) if value.ndim > 1 else value
            for value in _leaves(out).values()
            if value.dtype.is_floating_point
        ]
        # A sum is finite if all numbers are, unless it overflows: who sees that it is
        # not looks at the numbers themselves. Infinity less infinity is not a number.
        total = torch.stack(sums).sum(0) if len(sums) > 1 else sums[0]
        finite = total - total == 0.0
        rows = inputs.clone().reshape(-1).update(out)
        for head in self._heads:
            rows = head(rows)
        return [rows[self.action_key].unflatten(0, size), finite.unflatten(0, size)]

    def _traced(
        self, run: Any, inputs: TensorDictBase, members: slice
    ) -> TracedFunction | None:
        """A function of genomes and inputs as a graph, or None if it is not one."""
        genomes = self._chosen()[members]
        params, count = _leaves(genomes), genomes.batch_size
        leaves, size = _leaves(inputs), inputs.batch_size

        def flat(constants: Tensors, values: Tensors) -> Tensors:
            genomes = _nested(params, constants, count)
            return run(genomes, _nested(leaves, values, size))

        return trace(flat, list(params.values()), list(leaves.values()))

    def _call(self, params: TensorDictBase, inputs: TensorDictBase) -> TensorDictBase:
        # Tied weights have one name here, and functional_call knows the others.
        out: Any = functional_call(self._prefix, dict(params.items()), (inputs,))
        return out.select(*self._prefix.out_keys, strict=False)


class _Bound(NamedTuple):
    """A graph with the weights of some members."""

    run: Callable[..., tuple[torch.Tensor, ...]]
    is_pure: bool


def _leaves(values: TensorDictBase) -> dict[Any, torch.Tensor]:
    return dict(values.items(include_nested=True, leaves_only=True))


def _nested(
    names: Iterable[Any], values: Tensors, batch_size: torch.Size
) -> TensorDictBase:
    whole = TensorDict(batch_size=batch_size)
    for name, value in zip(names, values, strict=True):
        whole.set(name, value)
    return whole
