"""Many members of one actor's family, run as one batch."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential


class PopulationActor:
    """Run ``P`` members of an actor on ``[P * S]`` rows, member by member.

    The part of the actor that owns parameters is vectorised over members; the heads
    that own none (distributions, argmax) run on all rows at once, so actors whose
    heads ``torch.vmap`` refuses work too. The actor itself is never modified.

    Args:
        actor: Any TorchRL actor without lazy layers: a tensordict module, or a
            sequence of them.

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

    def __init__(self, actor: TensorDictModuleBase) -> None:
        self.actor = actor
        self._prefix, self._heads = _split(actor)
        self.in_keys = list(self._prefix.in_keys)
        self._names = {name for name, _ in self._prefix.named_parameters()}
        if not self._names:
            raise ValueError(f"{type(actor).__name__} has no parameters")
        self._params: TensorDictBase | None = None
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
        count = self._params.batch_size[0]
        inputs = rows.select(*self.in_keys)
        out = self._vmapped(self._params, inputs.reshape(count, -1)).reshape(-1)
        finite = torch.ones(rows.batch_size, dtype=torch.bool)
        for key in self._prefix.out_keys:
            value = out.get(key, None)
            if value is None or not value.dtype.is_floating_point:
                continue
            mask = torch.isfinite(value)
            if not bool(mask.all()):
                finite &= mask.reshape(mask.shape[0], -1).all(dim=1)
                # A neutral value keeps heads from raising; the row is marked instead.
                neutral = torch.ones_like if key == "scale" else torch.zeros_like
                out.set(key, torch.where(mask, value, neutral(value)))
        rows.update(out)
        for head in self._heads:
            rows = head(rows)
        return rows.set("policy_is_finite", finite)

    def _call(self, params: TensorDictBase, inputs: TensorDictBase) -> TensorDictBase:
        with params.to_module(self._prefix, preserve_module_state=False):
            return self._prefix(inputs).select(*self._prefix.out_keys, strict=False)


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
