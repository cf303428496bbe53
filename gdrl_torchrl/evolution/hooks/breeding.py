"""Children of the agent: what takes part in a contest beside its copy."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.operators.crossover import crossovers, no_crossover
from gdrl_torchrl.evolution.operators.genome import (
    only_part,
    paths_of_part,
    stack_copies,
)
from gdrl_torchrl.evolution.operators.mutation import (
    bernoulli_mutation,
    mutations,
    standard_deviation,
)
from gdrl_torchrl.evolution.operators.safe_mutation import safe_mutation
from gdrl_torchrl.evolution.operators.schedule import MutationSchedule
from gdrl_torchrl.evolution.population.outputs import outputs_of
from gdrl_torchrl.evolution.settings import EvolutionConfig

Mutation = Callable[..., TensorDictBase]
MakeSafe = Callable[[TensorDictBase, TensorDictBase, torch.Tensor], TensorDictBase]
"""``(genome, children [N], observations [B, D]) -> children [N]``."""


class Brood(NamedTuple):
    """Children, and how strongly they were changed."""

    genomes: TensorDictBase
    """``[N]``."""
    mut_p: float
    """Mutation probability."""


class Breeding(Protocol):
    """Makes children of the agent's genome."""

    def observe(self, batch: TensorDictBase) -> TensorDictBase:
        """Look at a training batch ``[T]`` or ``[W, T]``, and return it as it is."""
        ...

    def __call__(
        self,
        genome: TensorDictBase,
        success_rate: float | None,
        *,
        generator: torch.Generator,
    ) -> Brood:
        """Make children of a genome.

        Args:
            genome: The agent's.
            success_rate: Of the last training episodes; None as long as there are few.
            generator: Source of randomness.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """What later children depend on, but the generator."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        ...


class MutatedChildren:
    """Copies of the agent, mutated, less so the better it is, and perhaps crossed.

    Args:
        num_children: Children ``N``.
        mutation: ``(genomes [N], mut_p=, std=, generator=) -> genomes [N]``.
        std: Standard deviation of the mutation, in weight units.
        schedule: Mutation probability by success rate.
        crossover: ``(genomes [N], num_points=, generator=) -> genomes [N]``, of the
            mutated children.
        num_points: Cuts of the crossover.
        part: What mutates, see
            :func:`~gdrl_torchrl.evolution.operators.genome.paths_of_part`.
        make_safe: ``(genome, children [N], observations [B, D]) -> children [N]``: what
            limits how much the children differ, such as
            :func:`~gdrl_torchrl.evolution.operators.safe_mutation.safe_mutation`. None
            leaves them.
        divergence_rows: Observations of the last training batch that it gets.

    Raises:
        ValueError: If ``num_children`` < 1, or when children are made if the policy has no
            such part.

    Examples:
        >>> from tensordict import TensorDict
        >>> genome = TensorDict({"weight": torch.zeros(3, 2)})
        >>> breeding = MutatedChildren(num_children=4)
        >>> brood = breeding(genome, None, generator=torch.Generator().manual_seed(0))
        >>> brood.genomes["weight"].shape, brood.mut_p
        (torch.Size([4, 3, 2]), 0.75)
    """

    def __init__(
        self,
        num_children: int = 10,
        *,
        mutation: Mutation = bernoulli_mutation,
        std: float = 0.1,
        schedule: MutationSchedule | None = None,
        crossover: Mutation = no_crossover,
        num_points: int = 2,
        part: str = "all",
        make_safe: MakeSafe | None = None,
        divergence_rows: int = 256,
    ) -> None:
        if num_children < 1:
            raise ValueError(f"num_children={num_children} must be >= 1")
        self.num_children = num_children
        self.mutation = mutation
        self.std = std
        self.schedule = schedule or MutationSchedule()
        self.crossover = crossover
        self.num_points = num_points
        self.part = part
        self.make_safe = make_safe
        self.divergence_rows = divergence_rows
        self._observations: torch.Tensor | None = None

    def observe(self, batch: TensorDictBase) -> TensorDictBase:
        """Keep some observations of a training batch, if children are to be safe."""
        if self.make_safe is not None:
            seen = batch[keys.OBSERVATION]
            rows = seen.reshape(-1, seen.shape[-1])
            # Evenly spread over worlds and steps: no random choice is needed.
            stride = max(1, len(rows) // self.divergence_rows)
            self._observations = rows[::stride][: self.divergence_rows].clone()
        return batch

    def __call__(
        self,
        genome: TensorDictBase,
        success_rate: float | None,
        *,
        generator: torch.Generator,
    ) -> Brood:
        """Make children of a genome.

        Raises:
            RuntimeError: If children are to be safe, and no batch was observed.
        """
        mut_p = self.schedule(success_rate)
        copies = stack_copies(genome, self.num_children)
        children = self.mutation(copies, mut_p=mut_p, std=self.std, generator=generator)
        children = self.crossover(children, num_points=self.num_points, generator=generator)
        if self.part != "all":
            children = only_part(copies, children, paths_of_part(genome, self.part))
        if self.make_safe is not None:
            if self._observations is None:
                raise RuntimeError("divergence needs a training batch: none was observed")
            children = self.make_safe(genome, children, self._observations)
        return Brood(children, mut_p)

    def state_dict(self) -> dict[str, Any]:
        """The observations that were kept."""
        return {"observations": self._observations}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self._observations = state_dict["observations"]


def breeding_of(settings: EvolutionConfig, actor: TensorDictModuleBase) -> MutatedChildren:
    """What makes the children of an actor that settings ask for."""
    make_safe = None
    if settings.divergence is not None:
        make_safe = functools.partial(
            safe_mutation, outputs_of(actor), divergence=settings.divergence
        )
    return MutatedChildren(
        settings.num_children,
        mutation=mutations()[settings.mutation],
        std=standard_deviation(settings.mut_v, settings.mut_v_is),
        schedule=MutationSchedule(tuple(settings.rates), tuple(settings.thresholds)),
        crossover=crossovers()[settings.crossover],
        num_points=settings.num_points,
        part=settings.genome,
        make_safe=make_safe,
        divergence_rows=settings.divergence_rows,
    )
