"""Many members of one actor's family, run as one batch."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch.fx.experimental.proxy_tensor import make_fx
from torchrl.envs.utils import exploration_type

Graph = Callable[[list[torch.Tensor], list[torch.Tensor]], list[torch.Tensor]]


_logger = logging.getLogger(__name__)


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
        self._prefix, self._heads = _split(actor)
        self.in_keys = list(self._prefix.in_keys)
        self._names = {name for name, _ in self._prefix.named_parameters()}
        if not self._names:
            raise ValueError(f"{type(actor).__name__} has no parameters")
        self._params: TensorDictBase | None = None
        self._graphs: dict[Any, Graph | None] = {}
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

    def unload(self) -> None:
        """Forget the members."""
        self._params = None

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
    def actions(self, inputs: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
        """Act and give the actions alone, heads traced too where that is possible.

        Args:
            inputs: What the actor reads, ``[P, S]``.

        Returns:
            Actions ``[P, S, ...]`` and the mask of rows whose network output was a
            number ``[P, S]``.
        """
        graph = self._graph(inputs, whole=True)
        if graph is not None:
            action, finite = graph(self._values(), list(_leaves(inputs).values()))
            if bool(finite.all()):
                return action, finite
        rows = self(inputs.clone().reshape(-1))
        size = inputs.batch_size
        return (
            rows[self.action_key].unflatten(0, size),
            rows["policy_is_finite"].unflatten(0, size),
        )

    def _values(self) -> list[torch.Tensor]:
        assert self._params is not None
        return list(_leaves(self._params).values())

    def _outputs(self, inputs: TensorDictBase) -> dict[Any, torch.Tensor]:
        """Outputs ``[P, S, ...]`` of the members for inputs ``[P, S]``, by key."""
        assert self._params is not None
        graph = self._graph(inputs)
        if graph is None:
            return _leaves(self._vmapped(self._params, inputs))
        values = graph(self._values(), list(_leaves(inputs).values()))
        return dict(zip(self._prefix.out_keys, values, strict=True))

    def _graph(self, inputs: TensorDictBase, *, whole: bool = False) -> Graph | None:
        if not self.trace:
            return None
        # All that the operations depend on beside the numbers.
        key = (
            tuple((name, x.shape, x.dtype) for name, x in _leaves(inputs).items()),
            exploration_type(),
            self._prefix.training,
            whole,
        )
        if key not in self._graphs:
            run = self._run_whole if whole else self._run_prefix
            self._graphs[key] = self._traced(run, inputs)
        return self._graphs[key]

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
        finite = torch.ones(out.batch_size, dtype=torch.bool)
        for value in _leaves(out).values():
            if value.dtype.is_floating_point:
                finite = finite & torch.isfinite(value).reshape(len(value), -1).all(dim=1)
        rows = inputs.clone().reshape(-1).update(out)
        for head in self._heads:
            rows = head(rows)
        return [rows[self.action_key].unflatten(0, size), finite.unflatten(0, size)]

    def _traced(self, run: Any, inputs: TensorDictBase) -> Graph | None:
        """A function of genomes and inputs as a graph, or None if it is not one."""
        assert self._params is not None
        params, count = _leaves(self._params), self._params.batch_size
        leaves, size = _leaves(inputs), inputs.batch_size

        def flat(
            param_values: list[torch.Tensor], input_values: list[torch.Tensor]
        ) -> list[torch.Tensor]:
            genomes = _nested(params, param_values, count)
            return run(genomes, _nested(leaves, input_values, size))

        arguments = (list(params.values()), list(leaves.values()))
        try:
            expected = flat(*arguments)
            graph = make_fx(flat)(*arguments)
            same = all(
                torch.equal(torch.nan_to_num(one), torch.nan_to_num(other))
                for one, other in zip(graph(*arguments), expected, strict=True)
            )
        except Exception as error:  # whatever a module of a user raises when traced
            _logger.debug("%s is not traced: %s", type(self.actor).__name__, error)
            return None
        if not same:
            _logger.debug("%s is not traced: it is random", type(self.actor).__name__)
        return graph if same else None

    def _call(self, params: TensorDictBase, inputs: TensorDictBase) -> TensorDictBase:
        with params.to_module(self._prefix, preserve_module_state=False):
            return self._prefix(inputs).select(*self._prefix.out_keys, strict=False)


def _leaves(values: TensorDictBase) -> dict[Any, torch.Tensor]:
    return dict(values.items(include_nested=True, leaves_only=True))


def _nested(
    names: dict[Any, torch.Tensor], values: list[torch.Tensor], batch_size: torch.Size
) -> TensorDictBase:
    whole = TensorDict(batch_size=batch_size)
    for name, value in zip(names, values, strict=True):
        whole.set(name, value)
    return whole


def _dotted(key: Any) -> str:
    return key if isinstance(key, str) else ".".join(key)


def _split(
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
