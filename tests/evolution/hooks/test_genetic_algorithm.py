"""The plain genetic algorithm on a fitness that is known."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.genetic_algorithm import GeneticAlgorithm
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies

MEMBERS = 12


class NoisySphere:
    """Fitness is how near all weights are to 1, with noise that episodes average out."""

    num_episodes = 4

    def __init__(self, noise=0.0):
        self.noise, self.episodes_drawn = noise, 0
        self.calls = []

    def fresh_seeds(self, count):
        self.episodes_drawn += count
        return torch.arange(count)

    def evaluate(self, population, *, seeds=None):
        seeds = self.fresh_seeds(self.num_episodes) if seeds is None else seeds
        count, trials = population.batch_size[0], len(seeds)
        self.calls.append((count, trials))
        leaves = population.values(include_nested=True, leaves_only=True)
        near = -sum((leaf - 1.0).square().flatten(1).sum(dim=1) for leaf in leaves)
        rng = torch.Generator().manual_seed(self.episodes_drawn)
        noise = self.noise * torch.randn(count, generator=rng) / trials**0.5
        return TensorDict(
            {
                keys.FITNESS: near + noise,
                keys.RETURN_MEAN: near + noise,
                keys.SUCCESSES: torch.ones(count, trials, dtype=torch.bool),
                keys.FRAMES: torch.full((count,), 10 * trials),
            },
            batch_size=[count],
        )


@pytest.fixture
def start(actor_of):
    def make(evaluator=None, **options):
        torch.manual_seed(0)
        actor = actor_of("q_value")
        first = stack_copies(genome_of(actor), MEMBERS)
        return GeneticAlgorithm(evaluator or NoisySphere(), first, **options)

    return make


def test_it_climbs_and_never_loses_its_elite(start):
    algorithm = start(num_validated=0, std=0.05)
    best = [float(algorithm.evaluate().scores[keys.FITNESS].max()) for _ in range(150)]
    assert best == sorted(best)
    assert best[-1] > 0.3 * best[0], "the distance has shrunk"
    evaluator = NoisySphere()
    scores = evaluator.evaluate(algorithm.population)[keys.FITNESS]
    final = stack_copies(algorithm.final_genome(), 1)
    assert float(evaluator.evaluate(final)[keys.FITNESS]) == pytest.approx(
        float(scores[0]), rel=1e-5
    )


def test_the_best_few_play_again_and_all_steps_are_counted(start):
    algorithm = start(num_validated=3, validation_trials=7)
    evaluation = algorithm.evaluate()
    assert algorithm.evaluator.calls == [(MEMBERS, 4), (3, 7)]
    assert algorithm.evaluator.episodes_drawn == 11
    assert evaluation.population_steps == 10 * (MEMBERS * 4 + 3 * 7)
    assert algorithm.counts.steps == evaluation.population_steps
    assert len(algorithm.watch.window) == 7


def test_validation_makes_a_noisy_choice_better(start):
    def mean_of_elites(**options):
        total = 0.0
        algorithm = start(NoisySphere(noise=20.0), std=0.1, **options)
        for _ in range(60):
            algorithm.evaluate()
            elite = stack_copies(algorithm.final_genome(), 1)
            total += float(NoisySphere().evaluate(elite)[keys.FITNESS])
        return total

    assert mean_of_elites(num_validated=6, validation_trials=100) > mean_of_elites(
        num_validated=0
    )


def test_a_population_without_a_number_is_an_error(start):
    algorithm = start()
    algorithm.population.apply_(lambda leaf: leaf.fill_(float("nan")))
    with pytest.raises(FloatingPointError, match="fitness is NaN"):
        algorithm.evaluate()


def test_a_restored_population_goes_on_identically(start):
    whole = start()
    for _ in range(4):
        whole.evaluate()
    first, second = start(), start()
    first.evaluate()
    second.load_state_dict(first.state_dict())
    for _ in range(3):
        second.evaluate()
    assert (second.population == whole.population).all()
    assert second.counts == whole.counts


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_parents", 0),
        ("num_parents", MEMBERS + 1),
        ("num_validated", -1),
        ("validation_trials", 0),
    ],
)
def test_numbers_that_cannot_be_are_refused_by_name(name, value, start):
    with pytest.raises(ValueError, match=name):
        start(**{name: value})
