"""The best policy that an agent has been, to go back to when it has become worse."""

from __future__ import annotations

from typing import Any

import torch
from scipy.stats import fisher_exact
from torch import nn

LEAST_EPISODES = 20
"""Fewer tell nothing about a policy."""


class Champion:
    """Weights of a policy with the record that they had, and a test against it.

    The agent is said to have become worse by a one-sided exact test (Fisher 1922) of its
    last episodes against the champion's. Then its record counts those episodes too: they
    were begun by the champion, and who falls back again and again was overrated.

    Args:
        actor: The agent's policy.
        level: Probability that an agent as good as its champion is said to be worse; 0
            never says so.

    Attributes:
        successes: Of the champion's record.
        episodes: Of it; 0 as long as there is no champion.

    Examples:
        >>> champion = Champion(nn.Linear(3, 2), level=0.02)
        >>> champion.crown(6, 8)
        >>> champion.is_better_than(20, 40), champion.is_better_than(1, 40)
        (False, True)
    """

    def __init__(self, actor: nn.Module, *, level: float) -> None:
        self.actor, self.level = actor, level
        self.successes = self.episodes = 0
        self._weights: dict[str, torch.Tensor] = {}

    def __bool__(self) -> bool:
        return self.episodes > 0

    def crown(self, successes: int, episodes: int) -> None:
        """Take the agent's weights as they are now, with their record."""
        self.successes, self.episodes = successes, episodes
        self._weights = {
            name: parameter.detach().clone()
            for name, parameter in self.actor.named_parameters()
        }

    def is_worse_than(self, successes: int, episodes: int) -> bool:
        """Whether the agent's last episodes went better, on the mean."""
        return successes * self.episodes > self.successes * episodes

    def is_better_than(self, successes: int, episodes: int) -> bool:
        """Whether a test says that the agent has become worse."""
        table = [
            [self.successes, self.episodes - self.successes],
            [successes, episodes - successes],
        ]
        test: Any = fisher_exact(table, alternative="greater")
        return bool(test.pvalue < self.level)

    @torch.no_grad()
    def return_to(self, successes: int, episodes: int) -> None:
        """Write the champion's weights into the agent, and count its last episodes."""
        for name, parameter in self.actor.named_parameters():
            parameter.copy_(self._weights[name])
        self.successes += successes
        self.episodes += episodes

    def state_dict(self) -> dict[str, Any]:
        """Weights and record."""
        return {
            "weights": dict(self._weights),
            "successes": self.successes,
            "episodes": self.episodes,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self._weights = dict(state_dict["weights"])
        self.successes = int(state_dict["successes"])
        self.episodes = int(state_dict["episodes"])
