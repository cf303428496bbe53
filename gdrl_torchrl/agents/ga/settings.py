"""What the genetic algorithm can be told."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from gdrl_torchrl.checks import (
    MOST_WORLDS,
    among,
    check_at_most,
    check_evaluation_worlds,
    check_fields,
    within,
)


@dataclasses.dataclass
class GAConfig:
    """The genetic algorithm of Such et al. 2017 (https://arxiv.org/abs/1712.06567)."""

    actions: ClassVar[str] = "any"
    """Kind of actions that it needs."""
    collects: ClassVar[bool] = False
    """Whether the agent takes steps of its own: here only the population does."""

    name: str = among("ga", ("ga",))
    """Always ``ga``."""
    population_size: int = within(20, least=2, most=MOST_WORLDS)
    """Members of a generation."""
    num_parents: int = within(5, least=1, most=MOST_WORLDS)
    """Best members that the next generation is made of (truncation)."""
    num_trials: int = within(5, least=1, most=10_000)
    """Episodes that every member is scored on."""
    num_validated: int = within(5, least=0, most=MOST_WORLDS)
    """Best members that play again, to find the elite; 0 takes the first one."""
    validation_trials: int = within(10, least=1, most=10_000)
    """Episodes of each of those."""
    mutation_std: float = within(0.1, above=0.0, most=10.0)
    """Of the noise on every weight, in weight units."""
    fitness: str = among("goals", ("goals", "return"))
    """What members are scored by: ``goals`` that they reach, or the mean ``return``."""
    num_worlds: int | None = within(None, least=1, most=MOST_WORLDS)
    """Worlds of an evaluation; None takes one per member and trial."""

    def __post_init__(self) -> None:
        check_fields(self, "algorithm")
        for name in ("num_parents", "num_validated"):
            check_at_most("algorithm", self, name, "population_size")
        check_evaluation_worlds("algorithm", self, "population_size", self.population_size)
