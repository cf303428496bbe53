"""Many members of one actor's family, run as one batch."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch.func import functional_call
from torchrl.envs.utils import ExplorationType, exploration_type

from gdrl_torchrl.evolution.operators.genome import fitting_leaves
from gdrl_torchrl.evolution.population.member_graphs import MemberGraphs, leaves_of, nested
from gdrl_torchrl.evolution.population.members import (
    Reason,
    act_on,
    make_members,
    split_actor,
    why_one_by_one,
)
from gdrl_torchrl.evolution.population.prepared import (
    Run,
    acts_as_its_modules,
    prepared_run,
)
from gdrl_torchrl.fast.graph import Tensors, TracedFunction
from gdrl_torchrl.private_copy import fingerprint, private_copy

_logger = logging.getLogger(__name__)


class PopulationActor:
    """Run ``P`` members of an actor on ``[P * S]`` rows, member by member.

    Members are copies of the actor with weights of their own. The actor itself is only
    read: its modes, attributes and buffers are copied at every :meth:`load`.

    The part of the actor that has parameters is vectorised over members. The heads, which
    have none (distributions, argmax), run on all rows at once, so actors whose heads
    ``torch.vmap`` refuses work too. The vectorised part is traced once to a graph of
    tensor operations; this saves the time of Python, which is most of the time of small
    networks. The graph is used only if it gives the same numbers, bit for bit, as the
    vectorised modules on its first inputs; otherwise the modules are run. A greedy policy
    may offer something faster than a graph: :class:`~.prepared.Prepares`.

    On its first inputs a batch of members is also compared with members that act alone.
    If the batch acts otherwise (recurrent layers that vmap refuses, batch statistics,
    random layers, a state in buffers or attributes), members act one by one. Each is then
    a copy that keeps its own state from :meth:`load` on; the log says why.

    Args:
        actor: Any TorchRL actor without lazy layers: a tensordict module, or a
            sequence of them.
        trace: Whether to use graphs, or what the policy has prepared, instead of modules.
        action_key: Where the actor writes its action.

    Attributes:
        in_keys: What the actor reads.
        num_evolving: Number of weights of a member that come from its genome.
        reason: Why members act one by one, by the last comparison; empty if they act as a
            batch.

    Raises:
        ValueError: If the actor has no parameters, or cannot be copied.

    Examples:
        >>> from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
        >>> from gdrl_torchrl.agents.networks import make_tanh_normal_actor
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
        """Make members from genomes, and let all of them act.

        Args:
            genomes: Parameters ``[P]`` by nested name. Parameters that are missing, and
                all buffers, are copied from the actor as it is now.

        Raises:
            ValueError: If a leaf is not one of the actor's parameters, or has another
                shape or type.
        """
        parameters, kind = dict(self.actor.named_parameters()), cast(Any, type(self.actor))
        given = fitting_leaves(genomes, parameters, kind.__name__)
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
        self._graphs.unbind()

    def unload(self) -> None:
        """Forget the members."""
        self._all = self._params = self._members = None
        self._graphs.unbind()

    @property
    def graphs(self) -> dict[Any, TracedFunction | None]:
        """Of each kind of rows so far; None where tracing failed."""
        return self._graphs.graphs

    def acts_row_by_row(self, rows: TensorDictBase) -> bool:
        """Whether each row's action depends on that row and the weights alone.

        Args:
            rows: Possible inputs, ``[S]``, ``S`` >= 2.
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
            marked. Minus infinity, as a mask of forbidden actions, is kept where some
            action remains to be chosen.

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
        """Make a function of the members' actions, its heads traced where possible.

        Args:
            inputs: What the actor may read, ``[P, S]``: any numbers will do.
            parts: Number of parts that the members are split into, if there is a graph.
            run_all: ``map``, or ``map`` of a pool of threads, so that the parts run side
                by side. The actions are the same.

        Returns:
            A function of tensors like those of ``inputs``, in their order,
            ``[P, S, ...]``. It gives actions ``[P, S, ...]`` and the mask of rows whose
            network output was a number ``[P, S]``. It must not be used any more once
            other members are chosen.
        """
        run = None
        if self._is_vectorised(inputs) and self._may_trace:
            run = self._prepared(inputs, parts, run_all) or self._graphs.run_of(
                self._chosen(), inputs, parts, run_all
            )
        names, size = leaves_of(inputs), inputs.batch_size
        all_are_finite = torch.ones(size, dtype=torch.bool)

        def act(values: Tensors) -> tuple[torch.Tensor, torch.Tensor]:
            if run is not None:
                action, outputs = run(*values)
                if math.isfinite(outputs.sum().item()):
                    return action, all_are_finite
            rows = self(nested(names, values, size).reshape(-1))
            return (
                rows[self.action_key].unflatten(0, size),
                rows["policy_is_finite"].unflatten(0, size),
            )

        return act

    def _copy_actor(self, now: bytes | None) -> None:
        """Copy the actor anew, and forget what was known of the old copy."""
        self._fingerprint = now
        self._actor = private_copy(self.actor)
        self._prefix, self._heads = split_actor(self._actor)
        self._reasons: dict[Any, Reason] = {}
        self._may_prepare: dict[Any, bool] = {}
        self._vmapped = torch.vmap(self._call, in_dims=(0, 0), randomness="different")
        self._graphs = MemberGraphs(
            self._vmapped, self._prefix.out_keys, self._heads, self.action_key
        )

    def _prepared(self, inputs: TensorDictBase, parts: int, run_all: Any) -> Run | None:
        """What the policy has prepared itself, if it may be used for inputs ``[P, S]``."""
        is_greedy = exploration_type() is ExplorationType.DETERMINISTIC
        kinds = _kinds(inputs)
        if not is_greedy or [name for name, *_ in kinds] != self.in_keys or len(kinds) > 1:
            return None
        params = self._chosen()
        if kinds not in self._may_prepare:
            self._may_prepare[kinds] = acts_as_its_modules(
                self._actor, self._vmapped, self._heads, params, inputs, self.action_key
            )
        if not self._may_prepare[kinds]:
            return None
        return prepared_run(self._actor, params, parts=parts, run_all=run_all)

    @property
    def _may_trace(self) -> bool:
        # Without a fingerprint a change that makes graphs invalid would go unseen.
        return self.trace and self._fingerprint is not None

    def _chosen(self) -> TensorDictBase:
        if self._params is None:
            raise RuntimeError("no members are loaded: call load(genomes) first")
        return self._params

    def _is_vectorised(self, inputs: TensorDictBase) -> bool:
        """Whether members act as a batch as they would alone, on inputs ``[P, S]``."""
        key = (_kinds(inputs), exploration_type(), min(inputs.shape[1], 2))
        if key not in self._reasons:
            params = self._chosen()
            reason = why_one_by_one(self._actor, self._vmapped, params, inputs)
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
            acted.append(act_on(own.clone(), leaves_of(written), heads, self.action_key))
        return rows.update(torch.cat(acted))

    def _outputs(self, inputs: TensorDictBase) -> dict[Any, torch.Tensor]:
        """Outputs ``[P, S, ...]`` of the members for inputs ``[P, S]``, by key."""
        if self._may_trace:
            outputs = self._graphs.outputs(self._chosen(), inputs)
            if outputs is not None:
                return dict(zip(self._prefix.out_keys, outputs, strict=True))
        return leaves_of(self._vmapped(self._chosen(), inputs))

    def _call(self, params: TensorDictBase, inputs: TensorDictBase) -> TensorDictBase:
        # Tied weights have one name here; functional_call finds their other names.
        out: Any = functional_call(self._prefix, dict(params.items()), (inputs,))
        return out.select(*self._prefix.out_keys, strict=False)


def _kinds(inputs: TensorDictBase) -> tuple[Any, ...]:
    """Names, shapes and types of what a row of inputs ``[P, S]`` has."""
    return tuple((name, x.shape[2:], x.dtype) for name, x in leaves_of(inputs).items())
