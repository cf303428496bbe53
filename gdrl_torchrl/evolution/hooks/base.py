"""What all that evaluates populations has in common, and the hooks beside an agent."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.trainers.trainers import TrainerHookBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


@dataclasses.dataclass(frozen=True)
class GeneticEvaluation:
    """What one evaluation of a population found."""

    number: int
    mut_p: float | None
    """Mutation probability, where there is one."""
    scores: TensorDictBase
    """``fitness``, ``success_rate``, ``return_mean`` and ``frames`` of members."""
    winner: int
    """The best member, or the one that became the agent."""
    agent: int | None
    """The member that is a copy of the agent, if one is."""
    switched: bool
    """Whether the population changed the agent, or the agent the population."""
    population_steps: int
    value_shift: float | None = None
    """Of a switch: see :class:`~gdrl_torchrl.evolution.hooks.value_shift.ValueShift`."""


@dataclasses.dataclass
class PopulationCounts:
    """What populations have cost and done so far; all zero for a bare agent."""

    evaluations: int = 0
    switches: int = 0
    """Evaluations that changed the agent, or in which it changed the population."""
    without_fitness: int = 0
    """Evaluations in which no member had a fitness that is a number."""
    steps: int = 0
    """Environment steps."""

    def add(self, evaluation: GeneticEvaluation) -> None:
        """Count an evaluation."""
        self.evaluations += 1
        self.switches += int(evaluation.switched)
        self.without_fitness += int(evaluation.scores[keys.FITNESS].isnan().all())
        self.steps += evaluation.population_steps


class Evolution(abc.ABC):
    """Evaluates populations, and counts what that costs and gives.

    Args:
        evaluator: Scores populations, in an environment that no collector steps.
        watch: Counts episodes and their success; None makes one.
        seed: Seed of mutations and selections.
        on_evaluation: Called with each :class:`GeneticEvaluation`.

    Attributes:
        counts: What was evaluated so far.
    """

    def __init__(
        self,
        evaluator: PopulationEvaluator,
        *,
        watch: EpisodeWatch | None = None,
        seed: int = 0,
        on_evaluation: Sequence[Callable[[GeneticEvaluation], None]] = (),
    ) -> None:
        self.evaluator = evaluator
        self.watch = EpisodeWatch() if watch is None else watch
        self.on_evaluation = list(on_evaluation)
        self.generator = torch.Generator().manual_seed(seed)
        self.counts = PopulationCounts()

    @abc.abstractmethod
    def register(self, trainer: Any, name: str = "evolution") -> None:
        """Have a trainer call it after its steps."""

    @abc.abstractmethod
    def evaluate(self) -> GeneticEvaluation:
        """Evaluate a population now, and do what follows from it."""

    def final_genome(self) -> TensorDictBase | None:
        """Weights that the run's result is, where they are not the agent's."""
        return None

    def _note(self, evaluation: GeneticEvaluation) -> GeneticEvaluation:
        """Count an evaluation and tell those who asked."""
        self.counts.add(evaluation)
        for callback in self.on_evaluation:
            callback(evaluation)
        return evaluation

    def state_dict(self) -> dict[str, Any]:
        """Watch, counters and generators."""
        return {
            "watch": self.watch.state_dict(),
            "generator": self.generator.get_state(),
            "episodes_drawn": self.evaluator.episodes_drawn,
            "counts": dataclasses.asdict(self.counts),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.watch.load_state_dict(state_dict["watch"])
        self.generator.set_state(state_dict["generator"])
        self.evaluator.episodes_drawn = state_dict["episodes_drawn"]
        self.counts = PopulationCounts(**state_dict["counts"])


class PopulationHook(Evolution, TrainerHookBase):
    """Evaluates a population after every few episodes of the agent.

    Args:
        actor: The agent's policy.
        evaluator: Scores populations, in an environment that no collector steps.
        period_episodes: Training episodes between evaluations.
        **options: As of :class:`Evolution`.

    Raises:
        ValueError: If ``period_episodes`` < 1.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        evaluator: PopulationEvaluator,
        *,
        period_episodes: int,
        **options: Any,
    ) -> None:
        if period_episodes < 1:
            raise ValueError(f"period_episodes={period_episodes} must be >= 1")
        super().__init__(evaluator, **options)
        self.actor = actor
        self.period_episodes = period_episodes
        self._episodes_at_evaluation = 0
        self._trainer: Any = None

    def register(self, trainer: Any, name: str = "population_hook") -> None:
        """Register with a trainer: evaluations follow updates.

        The watch is registered too, unless it is already.

        Raises:
            ValueError: If the trainer collects asynchronously, see
                :meth:`~gdrl_torchrl.evolution.hooks.watch.EpisodeWatch.register`.
        """
        if not self.watch.is_registered:
            self.watch.register(trainer)
        self._trainer = trainer
        trainer.register_module(name, self)
        trainer.register_op("post_steps", self)

    def __call__(self) -> None:
        """Evaluate if that is due."""
        if self.is_due():
            self._episodes_at_evaluation = self.watch.episodes_completed
            self.evaluate()

    def is_due(self) -> bool:
        """Whether enough episodes have ended since the last evaluation."""
        since = self.watch.episodes_completed - self._episodes_at_evaluation
        return since >= self.period_episodes

    def state_dict(self) -> dict[str, Any]:
        """As of the base, and when the last evaluation was."""
        at = {"episodes_at_evaluation": self._episodes_at_evaluation}
        return super().state_dict() | at

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        self._episodes_at_evaluation = state_dict["episodes_at_evaluation"]
