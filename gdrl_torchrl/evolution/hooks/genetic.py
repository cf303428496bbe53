"""``GeneticHook``: the periodic genetic evaluation, as a hook for any TorchRL trainer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModuleBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.base import GeneticEvaluation, PopulationHook
from gdrl_torchrl.evolution.hooks.breeding import Breeding, MutatedChildren
from gdrl_torchrl.evolution.hooks.contest import PARENT, Contest, FullContest, Match
from gdrl_torchrl.evolution.hooks.hand_over import HandOver
from gdrl_torchrl.evolution.hooks.value_shift import ValueShift
from gdrl_torchrl.evolution.operators.genome import concatenate, genome_of, stack_copies
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


class GeneticHook(PopulationHook):
    """Every ``period_episodes`` episodes, let mutated children compete with the agent.

    At the first batch boundary after enough training episodes have ended, children are
    made of the agent; they and a copy of it compete, and the winner's weights are written
    into the agent in place (Marchesini and Farinelli, AAMAS 2020, section 2.1).

    Args:
        actor: The agent's policy.
        evaluator: Scores populations, in an environment that no collector steps.
        breeding: Makes the children; None mutates ten copies.
        contest: Scores the population and names the winner; None lets all members meet
            over the same episodes.
        hand_over: What happens on a switch; None replaces the agent's weights.
        period_episodes: Training episodes between evaluations.
        success_range: Success of the window, from the first to the second, both
            included, outside which an evaluation that is due waits until the agent is
            back in it.
        rate_of: What the mutation probability follows: success of the agent in the
            ``window`` of its training episodes, or of its copy in the last ``contest``.
        **options: As of :class:`~gdrl_torchrl.evolution.hooks.base.Evolution`.

    Raises:
        ValueError: If ``period_episodes`` < 1, or ``success_range`` decreases.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        evaluator: PopulationEvaluator,
        breeding: Breeding | None = None,
        contest: Contest | None = None,
        hand_over: HandOver | None = None,
        *,
        period_episodes: int = 50,
        success_range: Sequence[float] = (0.0, 1.0),
        rate_of: str = "window",
        **options: Any,
    ) -> None:
        if success_range[0] > success_range[1]:
            raise ValueError(f"success_range={success_range} must not decrease")
        super().__init__(actor, evaluator, period_episodes=period_episodes, **options)
        self.success_range = tuple(success_range)
        self.breeding: Breeding = MutatedChildren() if breeding is None else breeding
        self.contest: Contest = FullContest() if contest is None else contest
        self.hand_over = HandOver() if hand_over is None else hand_over
        self.rate_of = rate_of
        self.value_shift = ValueShift(actor)
        self._rate_in_contest: float | None = None

    def register(self, trainer: Any, name: str = "genetic_hook") -> None:
        """As of the base; the breeding sees the batches too."""
        super().register(trainer, name)
        trainer.register_op("batch_process", self.breeding.observe)
        trainer.register_op("batch_process", self.value_shift.observe)

    def is_due(self) -> bool:
        """As of the base, and whether the agent's success is in ``success_range``."""
        if not super().is_due():
            return False
        low, high = self.success_range
        # The window is empty as long as the very first episode runs.
        return low <= (self.watch.window.running_rate or 0.0) <= high

    def evaluate(self) -> GeneticEvaluation:
        """Make children, score them with the agent's copy, install the winner."""
        genome = genome_of(self.actor)
        in_window = self.rate_of == "window"
        rate = self.watch.window.rate if in_window else self._rate_in_contest
        brood = self.breeding(genome, rate, generator=self.generator)
        population = concatenate([stack_copies(genome, 1), brood.genomes])
        match = Match(
            self.evaluator,
            population,
            self.generator,
            keep_transitions=self.hand_over.share_experience is not None,
        )
        verdict = self.contest(match)
        if not in_window:
            self._rate_in_contest = float(verdict.scores[keys.SUCCESS_RATE][PARENT])
        switched = verdict.winner != PARENT
        shift = None
        if switched:
            winner = population[verdict.winner]
            self.hand_over.install(self.actor, genome, winner, self._trainer)
            shift = self.value_shift(genome, genome_of(self.actor))
        self.hand_over.share(verdict.transitions, switched=switched)
        evaluation = GeneticEvaluation(
            number=self.counts.evaluations,
            mut_p=brood.mut_p,
            scores=verdict.scores,
            winner=verdict.winner,
            agent=PARENT,
            switched=switched,
            population_steps=int(verdict.scores[keys.FRAMES].sum()),
            value_shift=shift,
        )
        return self._note(evaluation)

    def state_dict(self) -> dict[str, Any]:
        """As of the base, with the breeding's."""
        return super().state_dict() | {
            "breeding": self.breeding.state_dict(),
            "rate_in_contest": self._rate_in_contest,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        self._rate_in_contest = state_dict["rate_in_contest"]
        self.breeding.load_state_dict(state_dict["breeding"])
