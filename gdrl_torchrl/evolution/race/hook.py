"""``RaceHook``: large mutations race for the agent's place while the agent fails."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.base import GeneticEvaluation, PopulationHook
from gdrl_torchrl.evolution.hooks.hand_over import HandOver, reset_moments
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.evolution.race.breeding import RaceBreeding
from gdrl_torchrl.evolution.race.candidates import Candidate, Candidates
from gdrl_torchrl.evolution.settings import RaceConfig


class RaceHook(PopulationHook):
    """Races while the agent fails; the winner takes its place, and the gradient the rest.

    A contest of AAMAS 2020 lets every member play as many episodes as any other, whatever
    the first of them were like. Where next to nothing succeeds, that is a waste: here a
    member plays one episode, and on only if it reaches the goal (a race, as of Maron and
    Moore 1993, with Thompson sampling). Members are large mutations of the agent's first
    weights, and policies that are distilled from episodes which reached the goal. They act
    with the noise of training, for the gradient learns from what succeeds with it. Who
    succeeds again and again is tested on episodes of its own, and then becomes the agent.
    As long as the agent does not fail, nothing is evaluated.

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

    Raises:
        ValueError: If members are to be distilled, and the policy cannot be.
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
        self.candidates = Candidates(self.settings.most_candidates)
        self.breeding = RaceBreeding(actor, self.settings)
        self._seed, self._number = seed, 0
        self._agent_steps = self._began = 0
        follow: list[Callable[[], object]] = [self.watch.window.clear]
        if optimizer is not None:
            follow.append(reset_moments(optimizer, actor))
        self.hand_over = HandOver(on_switch=follow)

    def __call__(self) -> None:
        """Race if that is due."""
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
        if self.counts.switches and len(window) < self.settings.patience_episodes:
            return False
        # Before its first episode ends the agent is one that nothing speaks for.
        return (window.running_rate or 0.0) < self.settings.race_below

    def evaluate(self) -> GeneticEvaluation:
        """Run a round; test the best candidate, and make it the agent if it passes."""
        settings = self.settings
        rng = np.random.default_rng([self._seed, self._number])
        self._number += 1
        members = self.breeding.distilled(rng, self.generator)
        places = settings.num_members - len(members)
        again: list[Candidate] = []
        for _ in range(min(settings.num_again, places)):
            known = self.candidates.draw(rng, again)
            again += [] if known is None else [known]
        members += again
        members += self.breeding.new(settings.num_members - len(members), self.generator)
        scores = self._play(members, 1)
        self.candidates.keep(members)
        steps = int(scores[keys.FRAMES].sum())
        halvings = (self.counts.steps + steps - self._began) / settings.halving_steps
        agent = self.watch.window.running_rate or 0.0
        # Nobody takes the place of an agent that does better.
        least = max(settings.least_success * 0.5**halvings, agent)
        best = self.candidates.promising(least)
        switched = False
        if best is not None:
            record, test_steps = self._test(best)
            steps += test_steps
            if record >= least * settings.num_trials:
                self._hand_over(best)
                self._began = self.counts.steps + steps
                switched = True
        evaluation = GeneticEvaluation(
            number=self.counts.evaluations,
            mut_p=settings.new_rate,
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
        seen = transitions[keys.OBSERVATION].split(lengths.flatten().tolist())
        for row, column in successes.nonzero().tolist():
            self.breeding.show(members[row].genome, seen[row * trials + column])
        return scores

    def _test(self, candidate: Candidate) -> tuple[int, int]:
        """Successes of a candidate in episodes of its own, and their steps."""
        before = candidate.successes
        scores = self._play([candidate], self.settings.num_trials)
        return candidate.successes - before, int(scores[keys.FRAMES].sum())

    def _hand_over(self, candidate: Candidate) -> None:
        """Make a candidate the agent."""
        genome = candidate.genome
        if self.settings.hand_over == "random":
            genome = self.breeding.new(1, self.generator)[0].genome
        self.hand_over.install(self.actor, genome_of(self.actor), genome, self._trainer)
        self.candidates.clear()

    def state_dict(self) -> dict[str, Any]:
        """As of the base, with candidates and breeding."""
        return super().state_dict() | {
            "candidates": self.candidates.state_dict(),
            "breeding": self.breeding.state_dict(),
            "numbers": [self._number, self._agent_steps, self._began],
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        super().load_state_dict(state_dict)
        self.candidates.load_state_dict(state_dict["candidates"])
        self.breeding.load_state_dict(state_dict["breeding"])
        self._number, self._agent_steps, self._began = state_dict["numbers"]
