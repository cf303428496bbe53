"""Contests: that of AAMAS 2020, and the paired one with its error rate and its savings."""

from __future__ import annotations

import pytest
import torch
from scipy import stats
from tensordict import TensorDict

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.contest import (
    CopiesContest,
    FullContest,
    Match,
    PairedContest,
    RandomContest,
)
from gdrl_torchrl.evolution.operators.paired import HalvingPlan
from tests.marks import full_but

STEPS = 100


class CoinEvaluator:
    """Members reach a goal with a chance of their own; episodes last 100 steps."""

    num_episodes = 10

    def __init__(self, *chances, fitness="goals", seed=0):
        self.chances = torch.tensor(chances)
        self.fitness = fitness
        self.generator = torch.Generator().manual_seed(seed)
        self.episodes_drawn = 0
        self.played = []

    def population(self):
        numbers = torch.arange(len(self.chances), dtype=torch.float32)
        return TensorDict(number=numbers[:, None], batch_size=[len(numbers)])

    def fresh_seeds(self, count):
        self.episodes_drawn += count
        return torch.arange(self.episodes_drawn - count, self.episodes_drawn)

    def evaluate(self, population, *, seeds=None):
        seeds = self.fresh_seeds(self.num_episodes) if seeds is None else seeds
        members = population["number"][:, 0].long()
        self.played.append((members.tolist(), seeds.tolist()))
        chance = self.chances[members][:, None]
        draws = torch.rand(len(members), len(seeds), generator=self.generator)
        successes = draws < chance
        returns = successes.float() + chance
        fitness = successes.sum(dim=1).float()
        if self.fitness == "return":
            fitness = returns.mean(dim=1)
        return TensorDict(
            {
                keys.SUCCESSES: successes,
                keys.RETURNS: returns,
                keys.STEPS: torch.full((len(members), len(seeds)), STEPS),
                keys.RETURN_MEAN: returns.mean(dim=1),
                keys.SUCCESS_RATE: successes.float().mean(dim=1),
                keys.FRAMES: torch.full((len(members),), STEPS * len(seeds)),
                keys.FITNESS: fitness.masked_fill(torch.isnan(chance[:, 0]), torch.nan),
            },
            batch_size=[len(members)],
        )

    def evaluate_with_transitions(self, population, *, seeds=None):
        scores = self.evaluate(population, seeds=seeds)
        rows = int(scores[keys.SUCCESSES].numel())
        return scores, TensorDict(row=torch.arange(rows), batch_size=[rows])


def contest(evaluator, plan=None, **options):
    generator = torch.Generator().manual_seed(1)
    return PairedContest(plan)(
        Match(evaluator, evaluator.population(), generator, **options)
    )


@pytest.mark.parametrize("fitness", ["goals", "return"])
def test_the_full_contest_is_won_by_the_best_over_common_episodes(fitness):
    evaluator = CoinEvaluator(0.5, 0.0, 1.0, 0.5, fitness=fitness)
    verdict = FullContest()(Match(evaluator, evaluator.population(), torch.Generator()))
    assert verdict.winner == 2
    assert evaluator.played == [([0, 1, 2, 3], list(range(10)))]
    assert verdict.transitions is None


def test_children_are_halved_and_the_last_meets_the_parent_on_fresh_episodes():
    evaluator = CoinEvaluator(0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    verdict = contest(evaluator, HalvingPlan(screening_trials=2, test_trials=6))
    assert verdict.winner == 5
    sizes = [(len(members), len(seeds)) for members, seeds in evaluator.played]
    assert sizes == [(5, 2), (3, 2), (2, 2), (2, 6)]
    assert evaluator.played[-1][0] == [0, 5]
    seeds = [seed for _, seeds in evaluator.played for seed in seeds]
    assert len(seeds) == len(set(seeds)), "no episode comes twice"
    frames = verdict.scores[keys.FRAMES].tolist()
    assert sum(frames) == STEPS * sum(members * episodes for members, episodes in sizes)
    assert frames[0] == 6 * STEPS
    assert verdict.scores[keys.FITNESS].tolist()[5] == 10.0


def test_a_child_no_better_than_the_parent_stops_the_test_early():
    evaluator = CoinEvaluator(1.0, 0.0, 0.0)
    assert contest(evaluator).winner == 0
    tests = [members for members, _ in evaluator.played if 0 in members]
    assert len(tests) == 1


@pytest.mark.parametrize("chance", full_but([0.5], [0.2, 0.5, 0.8]))
def test_equal_children_win_no_more_often_than_the_level(chance):
    plan, wins, trials = HalvingPlan(), 0, 400
    for seed in range(trials):
        evaluator = CoinEvaluator(*[chance] * 11, seed=seed)
        wins += contest(evaluator, plan).winner != 0
    assert wins / trials <= plan.level + 3 * (plan.level * 0.8 / trials) ** 0.5


def test_a_much_better_child_nearly_always_wins_for_fewer_steps():
    wins = steps = 0
    for seed in range(100):
        evaluator = CoinEvaluator(0.2, *[0.2] * 9, 0.9, seed=seed)
        verdict = contest(evaluator)
        wins += verdict.winner == 10
        steps += int(verdict.scores[keys.FRAMES].sum())
    assert wins >= 85
    assert steps / 100 < 0.85 * 11 * 10 * STEPS, "less than all members over ten episodes"


def test_a_member_whose_policy_is_broken_never_wins():
    evaluator = CoinEvaluator(0.0, float("nan"), float("nan"))
    verdict = contest(evaluator)
    assert verdict.winner == 0
    assert torch.isnan(verdict.scores[keys.FITNESS][1:]).all()


def test_a_parent_whose_policy_is_broken_is_beaten_by_any_that_is_not():
    evaluator = CoinEvaluator(float("nan"), 0.0, 0.0)
    assert contest(evaluator).winner != 0
    evaluator = CoinEvaluator(float("nan"), float("nan"), float("nan"))
    assert contest(evaluator).winner == 0


def test_all_transitions_are_kept_when_they_are_asked_for():
    evaluator = CoinEvaluator(0.0, 0.0, 1.0)
    verdict = contest(evaluator, keep_transitions=True)
    episodes = sum(len(members) * len(seeds) for members, seeds in evaluator.played)
    assert verdict.transitions.batch_size == torch.Size([episodes])


def test_a_fitness_that_is_a_function_cannot_be_tested():
    evaluator = CoinEvaluator(0.0, 1.0, fitness=lambda result: result["x"])
    with pytest.raises(ValueError, match="fitness"):
        contest(evaluator)


def test_copies_play_as_much_as_a_population_over_episodes_of_their_own():
    evaluator = CoinEvaluator(0.4, 1.0, 1.0)
    population = evaluator.population()
    verdict = CopiesContest()(Match(evaluator, population, torch.Generator()))
    assert verdict.winner == 0
    assert evaluator.played == [([0], list(range(30)))]
    assert verdict.scores[keys.FRAMES].tolist() == [10 * STEPS] * 3
    full = CoinEvaluator(0.4, 1.0, 1.0)
    other = FullContest()(Match(full, full.population(), torch.Generator()))
    assert verdict.scores[keys.FRAMES].sum() == other.scores[keys.FRAMES].sum()
    assert set(verdict.scores.keys()) <= set(other.scores.keys())
    # The better members are never asked.
    assert (verdict.scores[keys.FITNESS] < 10).all()
    rate = verdict.scores[keys.SUCCESS_RATE]
    assert torch.equal(verdict.scores[keys.FITNESS], 10 * rate)


def test_a_member_is_drawn_whatever_it_reached_and_each_as_often():
    evaluator = CoinEvaluator(1.0, 0.0, 0.5)
    match = Match(evaluator, evaluator.population(), torch.Generator().manual_seed(0))
    verdicts = [RandomContest()(match) for _ in range(300)]
    counts = torch.bincount(torch.tensor([one.winner for one in verdicts]), minlength=3)
    assert stats.chisquare(counts.numpy()).pvalue > 0.001
    # What it costs, and what is told of it, is that of a full contest.
    full = CoinEvaluator(1.0, 0.0, 0.5)
    other = FullContest()(Match(full, full.population(), torch.Generator()))
    assert set(verdicts[0].scores.keys()) == set(other.scores.keys())
    assert verdicts[0].scores[keys.FRAMES].tolist() == other.scores[keys.FRAMES].tolist()


def test_a_member_without_numbers_is_never_drawn():
    nan = float("nan")
    evaluator = CoinEvaluator(nan, 0.0, nan)
    match = Match(evaluator, evaluator.population(), torch.Generator().manual_seed(0))
    assert {RandomContest()(match).winner for _ in range(20)} == {1}
    broken = CoinEvaluator(nan, nan)
    none = Match(broken, broken.population(), torch.Generator())
    assert RandomContest()(none).winner == 0, "the agent stays"


def test_copies_of_a_broken_agent_have_no_fitness_and_functions_are_refused():
    broken = CoinEvaluator(float("nan"), 1.0)
    population = broken.population()
    verdict = CopiesContest()(Match(broken, population, torch.Generator()))
    assert torch.isnan(verdict.scores[keys.FITNESS]).all()
    odd = CoinEvaluator(0.5, fitness=lambda scores: scores)
    with pytest.raises(ValueError, match="fitness"):
        CopiesContest()(Match(odd, odd.population(), torch.Generator()))
