"""Members of a race: new ones, and those that are distilled from others."""

from __future__ import annotations

from collections import deque
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
        self._shown: deque[Demonstration] = deque(maxlen=_MOST_DEMONSTRATIONS)

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
        self._shown.append(Demonstration(seen, _PART_OF_ACTION * action))

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
        """Members that do what a few others did who reached the goal, drawn for each."""
        if self._bind is None or len(self._shown) < _LEAST_IN_GROUP:
            return []
        shown = list(self._shown)
        most = min(len(shown), _MOST_IN_GROUP)
        groups = []
        for _ in range(min(self.settings.num_distilled, self.settings.num_members)):
            size = int(rng.integers(_LEAST_IN_GROUP, most + 1))
            chosen = rng.choice(len(shown), size=size, replace=False)
            groups.append([shown[i] for i in chosen])
        genomes, _ = distil(
            self._bind,
            self.first,
            groups,
            num_updates=self.settings.distillation_updates,
            generator=generator,
        )
        return [Candidate(genome.clone(), "distilled") for genome in genomes]

    def state_dict(self) -> dict[str, Any]:
        """First weights and demonstrations."""
        return {
            "first": self.first.to_dict(),
            "shown": [list(one) for one in self._shown],
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.first = TensorDict(state_dict["first"])
        self._shown.clear()
        self._shown.extend(Demonstration(*one) for one in state_dict["shown"])
