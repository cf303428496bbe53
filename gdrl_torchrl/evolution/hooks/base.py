"""What every hook that evaluates populations while an agent trains has in common."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.trainers.trainers import TrainerHookBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.watch import SuccessWindow
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


class PopulationHook(TrainerHookBase, abc.ABC):
    """Counts the agent's episodes and evaluates a population after every few of them.

    It also counts the evaluations in which no member had a fitness that is a number.

    Args:
        actor: The agent's policy.
        evaluator: Scores populations, in an environment that no collector steps.
        period_episodes: Training episodes between evaluations; None only watches.
        window_episodes: Training episodes that the success rate is over.
        seed: Seed of mutations and selections.
        success_key: Flag of success in the training batches.
        on_evaluation: Called with each :class:`GeneticEvaluation`.

    Raises:
        ValueError: If ``period_episodes`` < 1.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        evaluator: PopulationEvaluator,
        *,
        period_episodes: int | None = 50,
        window_episodes: int = 100,
        seed: int = 0,
        success_key: str = keys.SUCCESS,
        on_evaluation: Sequence[Callable[[GeneticEvaluation], None]] = (),
    ) -> None:
        if period_episodes is not None and period_episodes < 1:
            raise ValueError(f"period_episodes={period_episodes} must be >= 1")
        self.actor = actor
        self.evaluator = evaluator
        self.period_episodes = period_episodes
        self.window = SuccessWindow(window_episodes)
        self.success_key = success_key
        self.on_evaluation = list(on_evaluation)
        self.generator = torch.Generator().manual_seed(seed)
        self.num_evaluations = 0
        self.num_switches = 0
        self.num_without_fitness = 0
        self.population_steps = 0
        self.episodes_completed = 0
        self._episodes_at_evaluation = 0
        self._last_episode = -1
        self._trainer: Any = None

    def register(self, trainer: Any, name: str = "genetic_hook") -> None:
        """Register with a trainer: batches are observed, evaluations follow updates.

        Raises:
            ValueError: If the trainer collects asynchronously: it shows its hooks no
                batches, so no episode would ever be counted.
        """
        if getattr(trainer, "async_collection", False):
            raise ValueError(
                "async_collection=True: batches never reach the hook, so it would never "
                "evaluate; collect synchronously"
            )
        self._trainer = trainer
        trainer.register_module(name, self)
        trainer.register_op("batch_process", self.observe)
        trainer.register_op("post_steps", self)

    @abc.abstractmethod
    def evaluate(self) -> GeneticEvaluation:
        """Evaluate a population now, and do what follows from it."""

    def final_genome(self) -> TensorDictBase | None:
        """Weights that the run's result is, where they are not the agent's."""
        return None

    def __call__(self) -> None:
        """Evaluate if enough episodes have ended since the last evaluation."""
        if self.period_episodes is None:
            return
        since = self.episodes_completed - self._episodes_at_evaluation
        if since >= self.period_episodes:
            self._episodes_at_evaluation = self.episodes_completed
            self.evaluate()

    def observe(self, batch: TensorDictBase) -> TensorDictBase:
        """Count a batch's ended episodes and note their success, in starting order.

        Args:
            batch: Collected transitions ``[T]`` or ``[W, T]`` with ``episode_number``
                of the environment or, without it, the collector's trajectory ids.

        Returns:
            The batch itself.
        """
        done = batch["next", keys.DONE].reshape(-1)
        episode = batch.get(keys.EPISODE_NUMBER, None)
        if episode is None:
            episode = batch["collector", "traj_ids"]
        episode = episode.reshape(-1)
        self._note_starts(episode.unique().tolist())
        ended = episode[done]
        success = batch.get(("next", self.success_key), None)
        if success is None:
            flags = torch.zeros(len(ended), dtype=torch.bool)
        else:
            flags = success.reshape(-1)[done]
        for number, flag in zip(ended.tolist(), flags.tolist(), strict=True):
            self.window.finish(number, flag)
        self.episodes_completed += len(ended)
        return batch

    def _note_starts(self, episodes: list[int]) -> None:
        known = (n for n in episodes if n <= self._last_episode)
        if not all(self.window.is_open(number) for number in known):
            # An episode that had ended is back: numbers begin anew, as after a restart
            # with new episodes, and those that were running are gone.
            self.window.forget_running()
            self._last_episode = -1
        begun = [number for number in episodes if number > self._last_episode]
        self.window.begin(begun)
        if begun:
            self._last_episode = begun[-1]

    def _note(self, evaluation: GeneticEvaluation) -> GeneticEvaluation:
        """Count an evaluation and tell those who asked."""
        self.num_evaluations += 1
        self.num_switches += int(evaluation.switched)
        self.population_steps += evaluation.population_steps
        fitness = evaluation.scores[keys.FITNESS]
        self.num_without_fitness += int(torch.isnan(fitness).all())
        for callback in self.on_evaluation:
            callback(evaluation)
        return evaluation

    def state_dict(self) -> dict[str, Any]:
        """Window, counters and generators."""
        return {
            "window": self.window.state_dict(),
            "generator": self.generator.get_state(),
            "episodes_drawn": self.evaluator.episodes_drawn,
            "num_evaluations": self.num_evaluations,
            "num_switches": self.num_switches,
            "num_without_fitness": self.num_without_fitness,
            "population_steps": self.population_steps,
            "episodes_completed": self.episodes_completed,
            "episodes_at_evaluation": self._episodes_at_evaluation,
            "last_episode": self._last_episode,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.window.load_state_dict(state_dict["window"])
        self.generator.set_state(state_dict["generator"])
        self.evaluator.episodes_drawn = state_dict["episodes_drawn"]
        self.num_evaluations = state_dict["num_evaluations"]
        self.num_switches = state_dict["num_switches"]
        self.num_without_fitness = state_dict["num_without_fitness"]
        self.population_steps = state_dict["population_steps"]
        self.episodes_completed = state_dict["episodes_completed"]
        self._episodes_at_evaluation = state_dict["episodes_at_evaluation"]
        self._last_episode = state_dict["last_episode"]


class LivingPopulationHook(PopulationHook):
    """A hook whose population lives on from one evaluation to the next.

    Args:
        actor: A policy of the population's family.
        evaluator: Scores populations.
        population: The first generation, ``[P]``.
        **watching: As of :class:`PopulationHook`.

    Attributes:
        population: The generation that is scored next, ``[P]``.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        evaluator: PopulationEvaluator,
        population: TensorDictBase,
        **watching: Any,
    ) -> None:
        super().__init__(actor, evaluator, **watching)
        self.population = population

    def state_dict(self) -> dict[str, Any]:
        """As of the base, with the population."""
        return super().state_dict() | {"population": self.population.to_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        size = self.population.batch_size
        self.population = TensorDict.from_dict(state_dict["population"], batch_size=size)
