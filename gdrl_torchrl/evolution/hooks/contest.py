"""Who becomes the agent: contests between its copy and its children."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.operators.paired import (
    HalvingPlan,
    better_half,
    sign_flip_p_value,
)
from gdrl_torchrl.evolution.operators.selection import select_best
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.evolution.settings import EvolutionConfig

PARENT = 0
"""The agent's copy is the first member of its population."""


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What a contest found."""

    scores: TensorDictBase
    """``fitness``, ``success_rate``, ``return_mean`` and ``frames``, ``[1 + N]``."""
    winner: int
    transitions: TensorDictBase | None
    """``[T]``, whole episodes one after another, if they were asked for."""


@dataclasses.dataclass(frozen=True)
class Match:
    """The members of a contest, and what they play with."""

    evaluator: PopulationEvaluator
    population: TensorDictBase
    """``[1 + N]``; the first is the agent's copy."""
    generator: torch.Generator
    """Source of randomness."""
    keep_transitions: bool = False
    """Whether the verdict has the transitions of all episodes."""

    def play(
        self, members: TensorDictBase, seeds: torch.Tensor | None = None
    ) -> tuple[TensorDictBase, TensorDictBase | None]:
        """Scores ``[M]`` of members over episodes ``[S]``, and their transitions."""
        if self.keep_transitions:
            return self.evaluator.evaluate_with_transitions(members, seeds=seeds)
        return self.evaluator.evaluate(members, seeds=seeds), None

    def check_fitness_of_episodes(self) -> None:
        """Raise ValueError if fitness is a function, which has no value per episode."""
        fitness = self.evaluator.fitness
        if fitness not in ("goals", "return"):
            raise ValueError(
                f"fitness={fitness!r} must be 'goals' or 'return' for this contest"
            )


class Contest(Protocol):
    """Scores a population and names the member that becomes the agent."""

    def __call__(self, match: Match) -> Verdict:
        """Let the members compete."""
        ...


class FullContest:
    """All members over the same episodes; the best fitness wins.

    The rule of Marchesini and Farinelli (AAMAS 2020, section 2.1).

    Args:
        tie_rule: Who wins among equals, see
            :func:`~gdrl_torchrl.evolution.operators.selection.select_best`.
    """

    def __init__(self, tie_rule: str = "return_then_parent") -> None:
        self.tie_rule = tie_rule

    def __call__(self, match: Match) -> Verdict:
        """Let the members compete."""
        scores, transitions = match.play(match.population)
        winner = select_best(scores, parent=PARENT, tie_rule=self.tie_rule)
        return Verdict(scores, winner, transitions)


class PairedContest:
    """A child wins only if a paired test on common episodes says that it is better.

    See :class:`~gdrl_torchrl.evolution.operators.paired.HalvingPlan`: most children are
    dropped after a few episodes, and only the last one meets the parent. A test whose
    mean difference is not positive after a look ends there.

    Fitness is that of the evaluator over each member's own episodes, of which members
    that stayed longer had more; goals are counted per ``num_episodes``.

    Args:
        plan: Numbers of episodes, and the level of the test.
    """

    def __init__(self, plan: HalvingPlan | None = None) -> None:
        self.plan = plan or HalvingPlan()

    def __call__(self, match: Match) -> Verdict:
        """Let the members compete.

        Raises:
            ValueError: If the evaluator's fitness is a function: a test needs a value
                per episode.
        """
        match.check_fitness_of_episodes()
        tally = _Tally(match)
        alive = torch.arange(1, match.population.batch_size[0])
        for _, trials in self.plan.rounds(len(alive)):
            tally.play(alive, trials)
            alive = alive[better_half(tally.mean[alive])]
        winner = self._test(tally, int(alive[0]), match.generator)
        return Verdict(tally.scores(), winner, tally.transitions())

    def _test(self, tally: _Tally, child: int, generator: torch.Generator) -> int:
        differences = torch.zeros(0)
        for _ in range(self.plan.num_looks):
            values = tally.play(torch.tensor([PARENT, child]), self.plan.test_trials)
            if torch.isnan(values[0]).any() and not torch.isnan(values[1]).any():
                # A policy that gives no numbers is beaten by any that does.
                return child
            differences = torch.cat([differences, values[1] - values[0]])
            p_value = sign_flip_p_value(differences, generator=generator)
            if p_value <= self.plan.level / self.plan.num_looks:
                return child
            if not differences.mean() > 0.0:
                break
        return PARENT


class RandomContest:
    """All members play, and one of them is drawn: mutation at its full cost, unselected.

    Members whose policies give no numbers are never drawn; without any other the agent
    stays.
    """

    def __call__(self, match: Match) -> Verdict:
        """Draw a member, each with the same probability."""
        scores, transitions = match.play(match.population)
        whole = (~torch.isnan(scores[keys.FITNESS])).nonzero()[:, 0]
        drawn = PARENT
        if len(whole):
            drawn = int(whole[torch.randint(len(whole), (), generator=match.generator)])
        return Verdict(scores, drawn, transitions)


class CopiesContest:
    """No contest: copies of the agent play as much as a population would.

    Each copy has episodes of its own, so that no experience is had twice; the agent
    stays what it is. What a population costs and shares, without a population.
    """

    def __call__(self, match: Match) -> Verdict:
        """Let the agent play, whatever the other members are.

        Raises:
            ValueError: If the evaluator's fitness is a function.
        """
        match.check_fitness_of_episodes()
        evaluator = match.evaluator
        count, trials = match.population.batch_size[0], evaluator.num_episodes
        seeds = evaluator.fresh_seeds(count * trials)
        scores, transitions = match.play(match.population[PARENT : PARENT + 1], seeds)
        successes, returns, steps = (
            scores[key].reshape(count, trials)
            for key in (keys.SUCCESSES, keys.RETURNS, keys.STEPS)
        )
        goals = evaluator.fitness == "goals"
        fitness = successes.sum(dim=1).float() if goals else returns.mean(dim=1)
        entries = {
            keys.FITNESS: fitness.masked_fill(torch.isnan(scores[keys.FITNESS]), torch.nan),
            keys.SUCCESS_RATE: successes.float().mean(dim=1),
            keys.RETURN_MEAN: returns.mean(dim=1),
            keys.FRAMES: steps.sum(dim=1),
        }
        return Verdict(TensorDict(entries, batch_size=[count]), PARENT, transitions)


class _Tally:
    """Episodes of members that play different numbers of them."""

    def __init__(self, match: Match) -> None:
        count = match.population.batch_size[0]
        self.match, self.evaluator = match, match.evaluator
        self.episodes = torch.zeros(count)
        self.total = torch.zeros(count)
        self.successes = torch.zeros(count)
        self.returns = torch.zeros(count)
        self.frames = torch.zeros(count, dtype=torch.int64)
        self.log: list[Any] = []

    def play(self, members: torch.Tensor, trials: int) -> torch.Tensor:
        """Values ``[M, trials]`` of members over fresh common episodes."""
        seeds = self.evaluator.fresh_seeds(trials)
        scores, transitions = self.match.play(self.match.population[members], seeds)
        self.log.append(transitions)
        successes, returns = scores[keys.SUCCESSES].float(), scores[keys.RETURNS]
        values = successes if self.evaluator.fitness == "goals" else returns
        # A member whose policy is broken stays broken.
        broken = torch.isnan(scores[keys.FITNESS])
        values = values.masked_fill(broken[:, None], torch.nan)
        self.episodes[members] += trials
        self.total[members] += values.sum(dim=1)
        self.successes[members] += successes.sum(dim=1)
        self.returns[members] += returns.sum(dim=1)
        self.frames[members] += scores[keys.FRAMES]
        return values

    @property
    def mean(self) -> torch.Tensor:
        """Mean value over each member's own episodes, ``[1 + N]``."""
        return self.total / self.episodes

    def scores(self) -> TensorDictBase:
        """The entries that a contest reports."""
        goals = self.evaluator.fitness == "goals"
        return TensorDict(
            {
                keys.FITNESS: self.mean * (self.evaluator.num_episodes if goals else 1),
                keys.SUCCESS_RATE: self.successes / self.episodes,
                keys.RETURN_MEAN: self.returns / self.episodes,
                keys.FRAMES: self.frames,
            },
            batch_size=self.match.population.batch_size,
        )

    def transitions(self) -> TensorDictBase | None:
        """All transitions, if they were kept."""
        if not self.match.keep_transitions:
            return None
        whole: Any = TensorDict.cat(self.log)
        return whole


def contest_of(settings: EvolutionConfig) -> Contest:
    """The contest that settings ask for."""
    if settings.contest == "full":
        return FullContest(settings.tie_rule)
    if settings.contest == "copies":
        return CopiesContest()
    if settings.contest == "random":
        return RandomContest()
    return PairedContest(
        HalvingPlan(
            screening_trials=settings.screening_trials,
            test_trials=settings.test_trials,
            num_looks=settings.num_looks,
            level=settings.level,
        )
    )
