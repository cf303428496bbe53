"""Policies that a run keeps along its way, for a curve of held-out success."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn

from gdrl_torchrl.agents.loop import TrainingLoop
from gdrl_torchrl.evolution.operators.genome import genome_of

COSTS = ("agent_steps", "population_steps", "total_steps", "wall_s", "agent_episodes")
"""What is noted of the moment in which a policy is kept."""


class KeptPolicies:
    """Keeps the policy at equal steps of a budget; they are evaluated at the run's end.

    A policy is kept as soon as a step of training ends at or after its mark. A step that
    passes several marks, as a large evaluation does, keeps its policy for each.

    Args:
        count: How many are kept; the last one is that at the end of the budget.
        total_steps: The budget, steps of agent and populations.
        actor: The agent's policy.
        costs: The run's costs so far, by the names in :data:`COSTS`.
        result: What the run would end with in place of the agent's weights: a genome
            ``[]``, or None.

    Examples:
        >>> spent = dict.fromkeys(COSTS, 0.0)
        >>> kept = KeptPolicies(4, 100, nn.Linear(3, 2), lambda: spent)
        >>> spent["total_steps"] = 60.0
        >>> kept()
        >>> len(kept.points), kept.genomes()["weight"].shape
        (2, torch.Size([2, 2, 3]))
    """

    def __init__(
        self,
        count: int,
        total_steps: int,
        actor: nn.Module,
        costs: Callable[[], Mapping[str, float]],
        result: Callable[[], TensorDictBase | None] = lambda: None,
    ) -> None:
        self.count, self.total_steps = count, total_steps
        self.points: list[dict[str, float]] = []
        self._actor, self._costs, self._result = actor, costs, result
        self._genomes: list[TensorDictBase] = []

    def register(self, loop: TrainingLoop) -> None:
        """Register with a loop, after what changes the policy and before what saves."""
        loop.register_op("post_steps", self)

    def __call__(self) -> None:
        """Keep the policy for every mark that was reached since the last step."""
        costs = self._costs()
        reached = int(costs["total_steps"] * self.count // self.total_steps)
        while len(self.points) < min(reached, self.count):
            self.points.append({name: costs[name] for name in COSTS})
            self._genomes.append(self._genome())

    def genomes(self) -> TensorDictBase:
        """All parameters of the kept policies, ``[K]``, in the order of their marks."""
        stacked: Any = torch.stack(cast(Any, self._genomes))
        return stacked

    def state_dict(self) -> dict[str, Any]:
        """The policies so far, and the budget that their marks are of."""
        genomes = self.genomes().to_dict() if self._genomes else None
        return {
            "marks": [self.count, self.total_steps],
            "points": [dict(point) for point in self.points],
            "genomes": genomes,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`.

        Raises:
            ValueError: If its policies are those of another budget.
        """
        marks = state_dict["marks"]
        if list(marks) != [self.count, self.total_steps]:
            raise ValueError(
                f"budget.total_steps={self.total_steps} must be {marks[1]}: the run keeps "
                f"policies at {marks[0]} equal steps of that"
            )
        self.points = [dict(point) for point in state_dict["points"]]
        genomes = state_dict["genomes"]
        self._genomes = []
        if genomes is not None:
            stacked = TensorDict(genomes, batch_size=[len(self.points)])
            self._genomes = [genome.clone() for genome in stacked]

    def _genome(self) -> TensorDictBase:
        # All parameters: those that no greedy fitness sees matter when actions are drawn.
        genome = genome_of(self._actor, exclude=())
        result = self._result()
        return genome if result is None else genome.update(result.clone())
