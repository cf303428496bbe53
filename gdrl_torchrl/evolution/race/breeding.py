"""Members of a race: new ones, near ones, and those that are distilled."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from gdrl_torchrl.evolution.operators.distillation import Demonstration, distil
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.operators.mutation import bernoulli_mutation
from gdrl_torchrl.evolution.population.fitted import greedy_actions_of
from gdrl_torchrl.evolution.race.candidates import Candidate
from gdrl_torchrl.evolution.settings import RaceConfig

_MOST_DEMONSTRATIONS = 30
_LAST_SHOWN = 6
"""Of these the first of the distilled members is made, of a few at random the others."""
_LARGEST_ACTION = 0.98
"""No finite output of a squashed policy gives 1."""
_MOST_IN_GROUP = 4


class RaceBreeding:
    """Makes the members of a race.

    Args:
        actor: The agent's policy, whose weights now are those that new members are
            mutations of.
        settings: The race's.

    Raises:
        ValueError: If members are to be distilled, and the policy cannot be.
    """

    def __init__(self, actor: TensorDictModuleBase, settings: RaceConfig) -> None:
        self.settings = settings
        self.first = genome_of(actor)
        self._bind = greedy_actions_of(actor) if settings.num_distilled else None
        self._shown: deque[Demonstration] = deque(maxlen=_MOST_DEMONSTRATIONS)
        self._num_new = 0

    def show(self, demonstration: Demonstration) -> None:
        """Keep an episode that reached the goal."""
        if self._bind is not None:
            self._shown.append(demonstration)
            self._num_new += 1

    def member(
        self, known: Candidate | None, rng: np.random.Generator, generator: torch.Generator
    ) -> Candidate:
        """A candidate itself or a mutation of it, each as often, or a new member."""
        if known is None:
            settings = self.settings
            genome = self._mutated(
                self.first, settings.new_rate, settings.new_std, generator
            )
            return Candidate(genome, "new")
        if rng.random() < 0.5:
            return known
        genome = self._mutated(known.genome, 1.0, self.settings.near_std, generator)
        return Candidate(genome, "near")

    def distilled(
        self, rng: np.random.Generator, generator: torch.Generator
    ) -> list[Candidate]:
        """Members that do what others did who reached the goal, if there are new ones.

        Twice as many are fitted as are taken: those whose demonstrations contradict each
        other least.
        """
        count = min(self.settings.num_distilled, self.settings.num_members)
        if self._bind is None or not self._num_new:
            return []
        self._num_new = 0
        shown = list(self._shown)
        groups = [shown[-_LAST_SHOWN:]]
        for _ in range(2 * count - 1):
            size = min(len(shown), int(rng.integers(1, _MOST_IN_GROUP + 1)))
            chosen = rng.choice(len(shown), size=size, replace=False)
            groups.append([shown[i] for i in chosen])
        genomes, errors = distil(
            self._bind,
            self.first,
            [[_reachable(one) for one in group] for group in groups],
            num_updates=self.settings.distillation_updates,
            generator=generator,
        )
        best = errors.nan_to_num(torch.inf).argsort(stable=True)[:count].tolist()
        return [Candidate(genomes[i].clone(), "distilled") for i in best]

    def _mutated(
        self, genome: Any, rate: float, std: float, generator: torch.Generator
    ) -> Any:
        copies = stack_copies(genome, 1)
        return bernoulli_mutation(copies, mut_p=rate, std=std, generator=generator)[0]

    def state_dict(self) -> dict[str, Any]:
        """First weights and demonstrations."""
        return {
            "first": self.first.to_dict(),
            "shown": [list(one) for one in self._shown],
            "num_new": self._num_new,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.first = TensorDict(state_dict["first"])
        self._shown.clear()
        self._shown.extend(Demonstration(*one) for one in state_dict["shown"])
        self._num_new = int(state_dict["num_new"])


def _reachable(shown: Demonstration) -> Demonstration:
    """A demonstration whose actions a squashed policy can have."""
    action = shown.action.clamp(-_LARGEST_ACTION, _LARGEST_ACTION)
    return Demonstration(shown.observation.float(), action)
