"""The plain genetic algorithm: generations of a population, and no gradient."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.base import Evolution, GeneticEvaluation
from gdrl_torchrl.evolution.operators.generations import next_truncated_generation, ranking
from gdrl_torchrl.evolution.operators.selection import rank_scores
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


class GeneticAlgorithm(Evolution):
    """One generation at every step of what it is registered with.

    Every member is scored over the same fresh episodes; the best few and the elite play
    again, and the best of those is the new elite, which goes on unchanged; the rest of
    the next generation are mutated copies of the best members (Such et al. 2017,
    https://arxiv.org/abs/1712.06567, algorithm 1).

    Args:
        evaluator: Scores populations.
        population: The first generation, ``[P]``.
        num_parents: Best members that children are made of.
        num_validated: Best members that play again; 0 takes the first as the elite.
        validation_trials: Episodes of each of those.
        std: Standard deviation of the mutation, in weight units.
        **options: As of :class:`~gdrl_torchrl.evolution.hooks.base.Evolution`; the watch is
            over the elite's episodes.

    Attributes:
        population: The generation that is scored next, ``[P]``, the elite first.

    Raises:
        ValueError: If a number is out of range.
    """

    def __init__(
        self,
        evaluator: PopulationEvaluator,
        population: TensorDictBase,
        *,
        num_parents: int = 5,
        num_validated: int = 5,
        validation_trials: int = 10,
        std: float = 0.1,
        **options: Any,
    ) -> None:
        super().__init__(evaluator, **options)
        count = population.batch_size[0]
        for name, value, least in (
            ("num_parents", num_parents, 1),
            ("num_validated", num_validated, 0),
        ):
            if not least <= value <= count:
                raise ValueError(f"{name}={value} must be in [{least}, {count}]")
        if validation_trials < 1:
            raise ValueError(f"validation_trials={validation_trials} must be >= 1")
        self.population = population
        self.num_parents = num_parents
        self.num_validated = num_validated
        self.validation_trials = validation_trials
        self.std = std
        self._has_elite = False

    def register(self, trainer: Any, name: str = "genetic_algorithm") -> None:
        """Have a generation at every step of a trainer."""
        trainer.register_module(name, self)
        trainer.register_op("post_steps", self.evaluate)

    def evaluate(self) -> GeneticEvaluation:
        """Score the population and make the next generation."""
        scores = self.evaluator.evaluate(self.population)
        order = ranking(scores[keys.FITNESS], scores[keys.RETURN_MEAN])
        steps = int(scores[keys.FRAMES].sum())
        elite, judged, row = int(order[0]), scores, int(order[0])
        if self.num_validated:
            best = order[: self.num_validated]
            if self._has_elite and 0 not in best.tolist():
                # The elite plays again too, however its short episodes went.
                best = torch.cat([best, torch.zeros(1, dtype=best.dtype)])
            seeds = self.evaluator.fresh_seeds(self.validation_trials)
            judged = self.evaluator.evaluate(self.population[best], seeds=seeds)
            steps += int(judged[keys.FRAMES].sum())
            row = int(ranking(judged[keys.FITNESS], judged[keys.RETURN_MEAN])[0])
            elite = int(best[row])
        self.watch.note(judged[keys.SUCCESSES][row].tolist())
        evaluation = GeneticEvaluation(
            number=self.counts.evaluations,
            mut_p=None,
            scores=scores,
            winner=elite,
            agent=0 if self._has_elite else None,
            switched=self._has_elite and elite != 0,
            population_steps=steps,
        )
        if rank_scores(scores[keys.FITNESS]).max() == -torch.inf:
            raise FloatingPointError(
                "fitness is NaN for every member: the actions of all, or their returns, "
                "are no numbers"
            )
        self.population = next_truncated_generation(
            self.population,
            order,
            elite=elite,
            num_parents=self.num_parents,
            std=self.std,
            generator=self.generator,
        )
        self._has_elite = True
        return self._note(evaluation)

    def final_genome(self) -> TensorDictBase | None:
        """The elite, or None before the first generation."""
        return self.population[0].clone() if self._has_elite else None

    def state_dict(self) -> dict[str, Any]:
        """As of the base, with the population."""
        return super().state_dict() | {
            "population": self.population.to_dict(),
            "has_elite": self._has_elite,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        size = self.population.batch_size
        self.population = TensorDict.from_dict(state_dict["population"], batch_size=size)
        self._has_elite = bool(state_dict["has_elite"])
