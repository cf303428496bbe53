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

    What is kept for a mark is the policy that the run had by then: what an update or a
    contest that ends later will make of it is not known yet. A contest that passes
    several marks, or the end of the budget, leaves them the policy of before it.

    Args:
        count: How many are kept; the last one is that at the end of the budget.
        total_steps: The budget, steps of agent and populations.
        actor: The agent's policy, as it is before the first step.
        costs: The run's costs so far, by the names in :data:`COSTS`.
        result: What the run would end with in place of the agent's weights: a genome
            ``[]``, or None.

    Examples:
        >>> spent = dict.fromkeys(COSTS, 0.0)
        >>> kept = KeptPolicies(4, 100, nn.Linear(3, 2), lambda: spent)
        >>> for steps in (20.0, 60.0):
        ...     spent["total_steps"] = steps
        ...     kept()
        >>> [point["total_steps"] for point in kept.points]
        [20.0, 20.0]
        >>> kept.genomes()["weight"].shape
        torch.Size([2, 2, 3])
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
        self._last: tuple[dict[str, float], TensorDictBase]
        self._last = dict.fromkeys(COSTS, 0), self._genome()

    def register(self, loop: TrainingLoop) -> None:
        """Register with a loop, after what changes the policy and before what saves."""
        # Between an update and a contest the policy is one of its own.
        loop.register_op("post_optim", self)
        loop.register_op("post_steps", self)

    def __call__(self) -> None:
        """Keep for every mark that was passed the policy of before, and note this one."""
        costs = self._costs()
        steps = costs["total_steps"]
        while len(self.points) < self.count and self._mark() < steps:
            self._keep()
        self._last = {name: costs[name] for name in COSTS}, self._genome()
        if len(self.points) < self.count and self._mark() == steps:
            self._keep()

    def _mark(self) -> float:
        """Total steps of the next mark."""
        return (len(self.points) + 1) * self.total_steps / self.count

    def _keep(self) -> None:
        point, genome = self._last
        self.points.append(dict(point))
        self._genomes.append(genome)

    def genomes(self) -> TensorDictBase:
        """All parameters of the kept policies, ``[K]``, in the order of their marks."""
        stacked: Any = torch.stack(cast(Any, self._genomes))
        return stacked

    def state_dict(self) -> dict[str, Any]:
        """The policies so far, and the budget that their marks are of."""
        genomes = self.genomes().to_dict() if self._genomes else None
        point, last = self._last
        return {
            "marks": [self.count, self.total_steps],
            "points": [dict(point) for point in self.points],
            "genomes": genomes,
            "last_point": dict(point),
            "last_genome": last.to_dict(),
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
        last = TensorDict(state_dict["last_genome"], batch_size=[])
        self._last = dict(state_dict["last_point"]), last

    def _genome(self) -> TensorDictBase:
        # All parameters: those that no greedy fitness sees matter when actions are drawn.
        genome = genome_of(self._actor, exclude=())
        result = self._result()
        return genome if result is None else genome.update(result.clone())
