"""Members of a race: new ones, and those that are distilled from others."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from gdrl_torchrl.evolution.operators.distillation import Demonstration, distil
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.operators.mutation import bernoulli_mutation
from gdrl_torchrl.evolution.population.fitted import greedy_actions_of
from gdrl_torchrl.evolution.race.candidates import Candidate
from gdrl_torchrl.evolution.settings import RaceConfig

_MOST_DEMONSTRATIONS = 30
_LEAST_IN_GROUP, _MOST_IN_GROUP = 2, 4
"""Of one episode a policy learns to turn one way; those of many contradict each other."""
_PART_OF_ACTION = 0.98
"""A squashed policy has its largest actions at no finite output."""


class RaceBreeding:
    """Makes the members of a race.

    Args:
        actor: The agent's policy, whose weights now are those that all members are made
            from.
        settings: The race's.

    Raises:
        ValueError: If members are to be distilled, and the policy cannot be.
    """

    def __init__(self, actor: TensorDictModuleBase, settings: RaceConfig) -> None:
        self.settings = settings
        self.first = genome_of(actor)
        self._bind = greedy_actions_of(actor) if settings.num_distilled else None
        self._shown: dict[int, Demonstration] = {}
        self._num_shown = 0
        self._drawn: set[tuple[int, ...]] = set()

    def show(self, genome: TensorDictBase, observation: torch.Tensor) -> None:
        """Keep an episode that reached the goal.

        What is shown are the greedy actions where the member was, and the member acts with
        noise: so the episode shows the way back to the path as well (Laskey et al., DART,
        CoRL 2017, https://arxiv.org/abs/1703.09327).

        Args:
            genome: Of the member, ``[]``.
            observation: What it saw, ``[T, D]``.
        """
        if self._bind is None:
            return
        seen = observation.float()
        with torch.no_grad():
            action = self._bind(stack_copies(genome, 1))(seen[None])[0]
        self._shown[self._num_shown] = Demonstration(seen, _PART_OF_ACTION * action)
        forgotten = self._num_shown - _MOST_DEMONSTRATIONS
        self._shown.pop(forgotten, None)
        # Numbers of a group ascend: no group with a forgotten episode can come again.
        self._drawn = {group for group in self._drawn if group[0] > forgotten}
        self._num_shown += 1

    def new(self, count: int, generator: torch.Generator) -> list[Candidate]:
        """Large mutations of the first weights."""
        genomes: Any = bernoulli_mutation(
            stack_copies(self.first, count),
            mut_p=self.settings.new_rate,
            std=self.settings.new_std,
            generator=generator,
        )
        return [Candidate(genome.clone(), "new") for genome in genomes]

    def distilled(
        self, rng: np.random.Generator, generator: torch.Generator
    ) -> list[Candidate]:
        """Members that do what a few others did who reached the goal, drawn for each.

        No group of episodes is drawn twice, so that a few bad ones do not fill the race.
        """
        if self._bind is None:
            return []
        groups = []
        for _ in range(min(self.settings.num_distilled, self.settings.num_members)):
            group = self._draw(rng)
            if group is not None:
                groups.append([self._shown[number] for number in group])
        if not groups:
            return []
        genomes, _ = distil(
            self._bind,
            self.first,
            groups,
            num_updates=self.settings.distillation_updates,
            generator=generator,
        )
        return [Candidate(genome.clone(), "distilled") for genome in genomes]

    def _draw(self, rng: np.random.Generator) -> tuple[int, ...] | None:
        """Numbers of a few episodes; None if they were drawn before."""
        most = min(len(self._shown), _MOST_IN_GROUP)
        if most < _LEAST_IN_GROUP:
            return None
        size = int(rng.integers(_LEAST_IN_GROUP, most + 1))
        numbers = list(self._shown)
        group = tuple(sorted(rng.choice(numbers, size=size, replace=False).tolist()))
        if group in self._drawn:
            return None
        self._drawn.add(group)
        return group

    def state_dict(self) -> dict[str, Any]:
        """First weights and demonstrations."""
        return {
            "first": self.first.to_dict(),
            "shown": [[number, *one] for number, one in self._shown.items()],
            "num_shown": self._num_shown,
            "drawn": sorted(self._drawn),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.first = TensorDict(state_dict["first"])
        self._shown = {n: Demonstration(*one) for n, *one in state_dict["shown"]}
        self._num_shown = int(state_dict["num_shown"])
        self._drawn = set(map(tuple, state_dict["drawn"]))
