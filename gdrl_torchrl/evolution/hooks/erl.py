"""``ErlHook``: Evolutionary RL, a population that evolves beside the agent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.base import GeneticEvaluation, PopulationHook
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.evolution.operators.generations import next_erl_generation, ranking
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


class ErlHook(PopulationHook):
    """A population that lives on, fed by the agent and feeding its replay buffer.

    Evolutionary RL (Khadka and Tumer, NeurIPS 2018, https://arxiv.org/abs/1805.07917):
    every ``period_episodes`` training episodes the population is scored and makes its
    next generation by elitism, tournament selection, crossover and mutation; all its
    transitions enter the replay buffer, if the agent has one. Every ``sync_period``
    generations a copy of the agent takes the place of one of the new members. The agent
    itself learns by gradients only.

    An evaluation has ``switched`` if the agent's copy became one of the elites: the
    injections that the papers count as successful.

    Args:
        actor: The agent's policy.
        evaluator: Scores populations, in an environment that no collector steps.
        population: The first generation, ``[P]``.
        num_elites: Members that go on unchanged.
        tournament_size: Members drawn for a tournament.
        mutation_probability: Of each member that is no elite.
        sync_period: Generations between copies of the agent.
        share_experience: Called with all transitions ``[T]`` of a generation.
        watch: Counts the agent's episodes; None makes one.
        period_episodes: Training episodes between generations.
        seed: Seed of selection and mutation.
        on_evaluation: Called with each evaluation.

    Attributes:
        population: The generation that is scored next, ``[P]``.
        champion: Best member of the last scored generation, or None.

    Raises:
        ValueError: If a number is out of range.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        evaluator: PopulationEvaluator,
        population: TensorDictBase,
        *,
        num_elites: int = 2,
        tournament_size: int = 3,
        mutation_probability: float = 0.9,
        sync_period: int = 1,
        share_experience: Callable[[TensorDictBase], object] | None = None,
        watch: EpisodeWatch | None = None,
        period_episodes: int = 8,
        seed: int = 0,
        on_evaluation: Sequence[Callable[[GeneticEvaluation], None]] = (),
    ) -> None:
        super().__init__(
            actor,
            evaluator,
            watch=watch,
            period_episodes=period_episodes,
            seed=seed,
            on_evaluation=on_evaluation,
        )
        if sync_period < 1:
            raise ValueError(f"sync_period={sync_period} must be >= 1")
        count = population.batch_size[0]
        if not 1 <= num_elites < count - 1:
            raise ValueError(
                f"num_elites={num_elites} must be in [1, {count - 2}], so that one member "
                "is new and one is the agent's copy"
            )
        self.population = population
        self.num_elites = num_elites
        self.tournament_size = tournament_size
        self.mutation_probability = mutation_probability
        self.sync_period = sync_period
        self.share_experience = share_experience
        self.champion: TensorDictBase | None = None
        self._agent_is_in = False

    def evaluate(self) -> GeneticEvaluation:
        """Score the population and make the next generation."""
        if self.share_experience is None:
            scores = self.evaluator.evaluate(self.population)
        else:
            scores, transitions = self.evaluator.evaluate_with_transitions(self.population)
            self.share_experience(transitions)
        order = ranking(scores[keys.FITNESS], scores[keys.RETURN_MEAN])
        self.champion = self.population[int(order[0])].clone()
        last = len(order) - 1
        agent = last if self._agent_is_in else None
        evaluation = GeneticEvaluation(
            number=self.counts.evaluations,
            mut_p=None,
            scores=scores,
            winner=int(order[0]),
            agent=agent,
            switched=agent is not None and agent in order[: self.num_elites].tolist(),
            population_steps=int(scores[keys.FRAMES].sum()),
        )
        self.population = next_erl_generation(
            self.population,
            order,
            num_elites=self.num_elites,
            tournament_size=self.tournament_size,
            mutation_probability=self.mutation_probability,
            generator=self.generator,
        )
        self._agent_is_in = (evaluation.number + 1) % self.sync_period == 0
        if self._agent_is_in:
            self.population[last] = genome_of(self.actor)
        return self._note(evaluation)

    def final_genome(self) -> TensorDictBase | None:
        """The champion: the best member of the last generation that was scored."""
        return self.champion

    def state_dict(self) -> dict[str, Any]:
        """As of the base, with population and champion."""
        state = super().state_dict() | {
            "population": self.population.to_dict(),
            "agent_is_in": self._agent_is_in,
        }
        if self.champion is not None:
            state["champion"] = self.champion.to_dict()
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        size = self.population.batch_size
        self.population = TensorDict.from_dict(state_dict["population"], batch_size=size)
        self._agent_is_in = bool(state_dict["agent_is_in"])
        champion = state_dict.get("champion")
        if champion is not None:
            self.champion = TensorDict.from_dict(champion, batch_size=[])
