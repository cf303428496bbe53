"""Many members of one actor's family, run as one batch."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.envs.utils import exploration_type

from gdrl_torchrl.modules.graph import Tensors, TracedFunction, trace


class PopulationActor:
    """Run ``P`` members of an actor on ``[P * S]`` rows, member by member.

    The part of the actor that owns parameters is vectorised over members; the heads
    that own none (distributions, argmax) run on all rows at once, so actors whose
    heads ``torch.vmap`` refuses work too. The actor itself is never modified.

    The vectorised part is traced once to a graph of tensor operations and run without
    Python's share of the work, which for small networks is most of it. The graph is
    used only if it gives the same numbers, bit for bit, as the vectorised modules on
    its first inputs; otherwise the modules are run.

    Args:
        actor: Any TorchRL actor without lazy layers: a tensordict module, or a
            sequence of them.
        trace: Whether to trace. A policy that keeps a state in Python objects must not
            be.
        action_key: Where the actor writes its action.

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
        self.actor = actor
        self.trace = trace
        self.action_key = action_key
        self._prefix, self._heads = split_actor(actor)
        self.in_keys = list(self._prefix.in_keys)
        self._names = {name for name, _ in self._prefix.named_parameters()}
        if not self._names:
            raise ValueError(f"{type(actor).__name__} has no parameters")
        self._params: TensorDictBase | None = None
        self._graphs: dict[Any, TracedFunction | None] = {}
        self._loaded: dict[Any, _Bound] = {}
        self._vmapped = torch.vmap(self._call, in_dims=(0, 0), randomness="different")

    def load(self, genomes: TensorDictBase) -> None:
        """Choose the members.

        Args:
            genomes: Parameters ``[P]`` by nested name; those of the actor that are
                missing (and all buffers) are the actor's own.

        Raises:
            ValueError: If a name is not one of the actor's parameters.
        """
        given = {_dotted(key) for key in genomes.keys(True, True)}
        unknown = sorted(given - self._names)
        if unknown:
            raise ValueError(
                f"{type(self.actor).__name__} has no parameters {unknown}, which the "
                "genomes have"
            )
        count = genomes.batch_size[0]
        own: Any = TensorDict.from_module(self._prefix)
        whole = own.data.expand(count)
        # A locked view of the module: copied structure, shared memory.
        self._params = whole.copy().unlock_().update(genomes)
        self._loaded.clear()

    def unload(self) -> None:
        """Forget the members."""
        self._params = None
        self._loaded.clear()

    @torch.no_grad()
    def __call__(self, rows: TensorDictBase) -> TensorDictBase:
        """Act: rows ``[P * S]``, the members' rows one after another.

        Returns:
            ``rows`` with the actor's outputs and ``policy_is_finite`` ``[P * S]``: a
            row whose network output is not a number acts as if the output were 0.

        Raises:
            RuntimeError: If no members are loaded.
        """
        if self._params is None:
            raise RuntimeError("no members are loaded: call load(genomes) first")
        members = self._params.batch_size[0]
        inputs = rows.select(*self.in_keys).reshape(members, -1)
        finite = torch.ones(rows.batch_size, dtype=torch.bool)
        for key, value in self._outputs(inputs).items():
            value = value.flatten(0, 1)
            # The sum tells at once whether all numbers are, except when it overflows.
            if value.dtype.is_floating_point and not torch.isfinite(value.sum()):
                mask = torch.isfinite(value)
                finite &= mask.reshape(len(mask), -1).all(dim=1)
                # A neutral value keeps heads from raising; the row is marked instead.
                neutral = torch.ones_like if key == "scale" else torch.zeros_like
                value = torch.where(mask, value, neutral(value))
            rows.set(key, value)
        for head in self._heads:
            rows = head(rows)
        return rows.set("policy_is_finite", finite)

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
            was a number ``[P, S]``. Loading other members ends its use.
        """
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

    def _outputs(self, inputs: TensorDictBase) -> dict[Any, torch.Tensor]:
        """Outputs ``[P, S, ...]`` of the members for inputs ``[P, S]``, by key."""
        bound = self._bound(inputs)
        if bound is None:
            assert self._params is not None
            return _leaves(self._vmapped(self._params, inputs))
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
        if not self.trace:
            return None
        values = _leaves(inputs)
        # All that the operations depend on beside the numbers.
        key = (
            tuple((name, x.shape, x.dtype) for name, x in values.items()),
            exploration_type(),
            self._prefix.training,
            whole,
        )
        if key not in self._graphs:
            run = self._run_whole if whole else self._run_prefix
            self._graphs[key] = self._traced(run, inputs, members)
        graph = self._graphs[key]
        if graph is None:
            return None
        loaded = (*key, members.start)
        if loaded not in self._loaded:
            assert self._params is not None
            leaves = _leaves(self._params[members]).values()
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
        assert self._params is not None
        genomes: Any = self._params[members]
        params, count = _leaves(genomes), genomes.batch_size
        leaves, size = _leaves(inputs), inputs.batch_size

        def flat(constants: Tensors, values: Tensors) -> Tensors:
            genomes = _nested(params, constants, count)
            return run(genomes, _nested(leaves, values, size))

        return trace(flat, list(params.values()), list(leaves.values()))

    def _call(self, params: TensorDictBase, inputs: TensorDictBase) -> TensorDictBase:
        with params.to_module(self._prefix, preserve_module_state=False):
            return self._prefix(inputs).select(*self._prefix.out_keys, strict=False)


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


def _dotted(key: Any) -> str:
    return key if isinstance(key, str) else ".".join(key)


def split_actor(
    actor: TensorDictModuleBase,
) -> tuple[TensorDictModuleBase, list[TensorDictModuleBase]]:
    """The shortest beginning of an actor that owns all its parameters, and the rest."""
    if not isinstance(actor, TensorDictSequential):
        return actor, []
    parts: list[Any] = list(actor.module)
    owners = [i for i, part in enumerate(parts) if any(True for _ in part.parameters())]
    if not owners:
        raise ValueError(f"{type(actor).__name__} has no parameters")
    cut = owners[-1] + 1
    # Names stay those of the whole actor: module.0, module.1, ...
    return TensorDictSequential(*parts[:cut]), parts[cut:]
