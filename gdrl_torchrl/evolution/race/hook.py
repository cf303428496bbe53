"""``RaceHook``: large mutations race for the agent's place while the agent fails."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.base import GeneticEvaluation, PopulationHook
from gdrl_torchrl.evolution.hooks.hand_over import (
    HandOver,
    reset_moments,
    update_collector,
)
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.evolution.operators.distillation import Demonstration
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.evolution.population.rules import exploration_of
from gdrl_torchrl.evolution.race.breeding import RaceBreeding
from gdrl_torchrl.evolution.race.candidates import Candidate, Candidates
from gdrl_torchrl.evolution.race.champion import LEAST_EPISODES, Champion
from gdrl_torchrl.evolution.race.noise import ActionNoise
from gdrl_torchrl.evolution.settings import RaceConfig

_logger = logging.getLogger(__name__)
_MOST_HALVINGS = 2
"""Of the noise of a new agent: a quarter is taken without a look."""


class RaceHook(PopulationHook):
    """Races while the agent fails; the winner takes its place, and the gradient the rest.

    A contest of AAMAS 2020 lets every member play as many episodes as any other, whatever
    the first of them were like. Where next to nothing succeeds, that is a waste: here a
    member plays one episode, and on only if it reaches the goal (a race, as of Maron and
    Moore 1993, with Thompson sampling). Members are large mutations of the agent's first
    weights, small ones of those that have succeeded, and policies that are distilled from
    the episodes which reached the goal. Who succeeds again and again is tested on episodes
    of its own, and then becomes the agent. As long as the agent does not fail, nothing is
    evaluated.

    The agent that an inheritance or the gradient ruins goes back to the best that it has
    been (:class:`~gdrl_torchrl.evolution.race.champion.Champion`).

    Args:
        actor: The agent's policy.
        evaluator: Scores populations, in an environment that no collector steps, which
            has a flag of success.
        settings: What the race can be told.
        optimizer: Forgets its moments of the actor when the actor changes.
        watch: Counts the agent's episodes; its window is emptied when the actor changes.
            None makes one.
        seed: Seed of mutations and draws.
        on_evaluation: Called with the evaluation of each round.

    Attributes:
        candidates: Members that have succeeded.
        champion: The best that the agent has been.
        num_rollbacks: How often it went back.

    Raises:
        ValueError: If ``action_std`` is given and the policy has no such parameter, or
            members are to be distilled and cannot be.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        evaluator: PopulationEvaluator,
        settings: RaceConfig | None = None,
        *,
        optimizer: torch.optim.Optimizer | None = None,
        watch: EpisodeWatch | None = None,
        seed: int = 0,
        on_evaluation: Sequence[Callable[[GeneticEvaluation], None]] = (),
    ) -> None:
        self.settings = RaceConfig() if settings is None else settings
        if watch is None:
            watch = EpisodeWatch(self.settings.window_episodes)
        super().__init__(
            actor,
            evaluator,
            period_episodes=self.settings.patience_episodes,
            watch=watch,
            seed=seed,
            on_evaluation=on_evaluation,
        )
        std = self.settings.action_std
        self.noise = None if std is None else ActionNoise(actor)
        self.candidates = Candidates(self.settings.most_candidates)
        self.champion = Champion(actor, level=self.settings.rollback_level)
        self.breeding = RaceBreeding(actor, self.settings)
        self.num_rollbacks = 0
        self._seed, self._number = seed, 0
        self._agent_steps = 0
        # What follows whenever the actor has other weights.
        self._follow: list[Callable[[], object]] = [self.watch.window.clear]
        if optimizer is not None:
            self._follow.append(reset_moments(optimizer, actor))
        self.hand_over = HandOver(on_switch=self._follow)

    def __call__(self) -> None:
        """Go back if the agent has become worse; race if that is due."""
        if self._goes_back():
            return
        steps = int(self._trainer.collected_frames)
        passed, self._agent_steps = steps - self._agent_steps, steps
        if not self.is_due():
            return
        share = self.settings.share
        owed, before = passed * share / (1.0 - share), self.counts.steps
        while self.counts.steps - before < owed and not self.evaluate().switched:
            pass

    def is_due(self) -> bool:
        """Whether the agent fails, and has had time to succeed."""
        window = self.watch.window
        if self.champion and len(window) < self.settings.patience_episodes:
            return False
        # Before its first episode ends the agent is one that nothing speaks for.
        return (window.running_rate or 0.0) < self.settings.race_below

    def evaluate(self) -> GeneticEvaluation:
        """Run a round; test the best candidate, and make it the agent if it passes."""
        rng = np.random.default_rng([self._seed, self._number])
        self._number += 1
        members = self.breeding.distilled(rng, self.generator)
        busy: list[Candidate] = []
        while len(members) < self.settings.num_members:
            known = self.candidates.draw(rng, busy)
            member = self.breeding.member(known, rng, self.generator)
            busy += [member] if member is known else []
            members.append(member)
        scores = self._play(members, 1)
        self.candidates.keep(members)
        steps = int(scores[keys.FRAMES].sum())
        best = self.candidates.promising(self.settings.least_success)
        switched = False
        if best is not None:
            record, test_steps = self._test(best)
            steps += test_steps
            if record >= self.settings.least_success * self.settings.num_trials:
                steps += self._hand_over(best, record, rng)
                switched = True
        evaluation = GeneticEvaluation(
            number=self.counts.evaluations,
            mut_p=self.settings.new_rate,
            scores=scores,
            winner=int(scores[keys.FITNESS].nan_to_num(-torch.inf).argmax()),
            agent=None,
            switched=switched,
            population_steps=steps,
        )
        return self._note(evaluation)

    def _play(self, members: list[Candidate], trials: int) -> TensorDictBase:
        """Let members play common episodes; their records and the breeding learn of it."""
        genomes: Any = torch.stack([member.genome for member in members])
        seeds = self.evaluator.fresh_seeds(trials)
        scores, transitions = self.evaluator.evaluate_with_transitions(genomes, seeds=seeds)
        # A member whose policy gives no numbers has reached nothing.
        whole = ~torch.isnan(scores[keys.FITNESS])
        successes: Any = scores[keys.SUCCESSES] & whole[:, None]
        for member, won in zip(members, successes.sum(dim=1).tolist(), strict=True):
            member.add(won, trials)
        lengths: Any = scores[keys.STEPS]
        episodes = transitions.split(lengths.flatten().tolist())
        for episode, won in zip(episodes, successes.flatten().tolist(), strict=True):
            if won:
                shown = Demonstration(episode[keys.OBSERVATION], episode[keys.ACTION])
                self.breeding.show(shown)
        return scores

    def _test(self, candidate: Candidate) -> tuple[int, int]:
        """Successes of a candidate in episodes of its own, and their steps."""
        before = candidate.successes
        scores = self._play([candidate], self.settings.num_trials)
        return candidate.successes - before, int(scores[keys.FRAMES].sum())

    def _hand_over(
        self, candidate: Candidate, successes: int, rng: np.random.Generator
    ) -> int:
        """Make a candidate the agent; the steps that finding its noise takes."""
        genome = candidate.genome
        if self.settings.hand_over == "random":
            genome = self.breeding.member(None, rng, self.generator).genome
        steps = self._fit_noise(genome, successes)
        self.hand_over.install(self.actor, genome_of(self.actor), genome, self._trainer)
        self.champion.crown(successes, self.settings.num_trials)
        self.candidates.clear()
        return steps

    def _fit_noise(self, genome: TensorDictBase, successes: int) -> int:
        """Give the agent as much noise as the genome bears; the steps that this takes.

        The gradient learns from what succeeds with noise. The first of a few standard
        deviations, each half of the one before, is taken with which at least half of the
        greedy successes are left.
        """
        steps, largest = 0, self.settings.action_std
        if self.noise is None or largest is None:
            return steps
        greedy = self.evaluator.exploration_type
        self.evaluator.exploration_type = exploration_of("sampled")
        try:
            for halvings in range(_MOST_HALVINGS + 1):
                self.noise.set(largest * 0.5**halvings)
                if halvings == _MOST_HALVINGS:
                    break
                seeds = self.evaluator.fresh_seeds(self.settings.num_trials)
                scores = self.evaluator.evaluate(stack_copies(genome, 1), seeds=seeds)
                steps += int(scores[keys.FRAMES].sum())
                if 2 * int(scores[keys.SUCCESSES].sum()) >= successes:
                    break
        finally:
            self.evaluator.exploration_type = greedy
        return steps

    def _goes_back(self) -> bool:
        """Look at the agent's last episodes; return to the champion if they say so."""
        successes, episodes = self._successes(), len(self.watch.window)
        if not self.champion or episodes < LEAST_EPISODES:
            return False
        if self.champion.is_worse_than(successes, episodes):
            self.champion.crown(successes, episodes)
            return False
        if not self.champion.is_better_than(successes, episodes):
            return False
        self.champion.return_to(successes, episodes)
        if self.noise is not None:
            self.noise.scale(self.settings.rollback_noise)
        self.num_rollbacks += 1
        _logger.info("back to an earlier policy: %d of %d goals", successes, episodes)
        for follow in self._follow:
            follow()
        update_collector(self._trainer)
        return True

    def _successes(self) -> int:
        return self.watch.window.num_successes

    def state_dict(self) -> dict[str, Any]:
        """As of the base, with candidates, champion and breeding."""
        return super().state_dict() | {
            "candidates": self.candidates.state_dict(),
            "champion": self.champion.state_dict(),
            "breeding": self.breeding.state_dict(),
            "numbers": [self._number, self._agent_steps, self.num_rollbacks],
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        self.candidates.load_state_dict(state_dict["candidates"])
        self.champion.load_state_dict(state_dict["champion"])
        self.breeding.load_state_dict(state_dict["breeding"])
        self._number, self._agent_steps, self.num_rollbacks = state_dict["numbers"]
