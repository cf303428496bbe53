"""Generations of ERL and of the plain genetic algorithm, against published numbers."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from gdrl_torchrl.evolution.operators.generations import (
    erl_mutation,
    next_erl_generation,
    next_truncated_generation,
    ranking,
    tournament,
)

NAN = float("nan")
SCORES = st.lists(st.sampled_from([NAN, 0.0, 1.0, 2.0]), min_size=1, max_size=6)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def numbered(count, *shape):
    """A population whose every weight is its member's number."""
    value = torch.arange(count, dtype=torch.float32).reshape(-1, *[1] * len(shape))
    leaf = value.expand(count, *shape).clone()
    return TensorDict({("net", "weight"): leaf, "bias": leaf[..., 0].clone()}, [count])


@given(table=SCORES.flatmap(lambda f: st.tuples(st.just(f), st.permutations(f))))
def test_ranking_sorts_by_fitness_then_return_then_index(table):
    fitness, returns = table

    def number(score):
        return -math.inf if math.isnan(score) else score

    expected = sorted(
        range(len(fitness)), key=lambda i: (-number(fitness[i]), -number(returns[i]), i)
    )
    assert ranking(torch.tensor(fitness), torch.tensor(returns)).tolist() == expected


def test_tournaments_are_won_by_the_best_of_those_drawn():
    order = torch.tensor([3, 1, 0, 2])
    wins = tournament(order, 60_000, size=3, generator=generator()).bincount() / 60_000
    # The chance that nobody better was drawn, less that of nobody as good.
    for place, member in enumerate(order.tolist()):
        expected = ((4 - place) / 4) ** 3 - ((3 - place) / 4) ** 3
        assert abs(float(wins[member]) - expected) < 0.01


# ERL's mutation: the statistics of the published code


@pytest.fixture(scope="module")
def mutated():
    """Many matrices of ones, with what the mutation made of them, ``[P, 20, 10]``."""
    ones = TensorDict(weight=torch.ones(20_000, 20, 10), batch_size=[20_000])
    return erl_mutation(ones, generator=generator())["weight"]


def test_a_matrix_is_chosen_with_twice_a_uniform_probability(mutated):
    touched = (mutated != 1.0).flatten(1).sum(dim=1)
    # P(u1 < min(1, 2 u2)) = 3/4, and one of twenty counts of weights is none.
    assert abs(float((touched > 0).float().mean()) - 0.75 * 19 / 20) < 0.01
    assert int(touched.max()) == 19, "fewer than a tenth of 200, as of range(0, 20)"
    counts = touched[touched > 0].bincount(minlength=20)[1:].float()
    assert torch.allclose(counts / counts.sum(), torch.full((19,), 1 / 19), atol=0.01)


def test_most_mutations_are_small_some_super_and_some_resets(mutated):
    change = mutated[mutated != 1.0] - 1.0
    # A mixture of N(0, 0.1), N(0, 10) and, for a reset, N(-1, 1).
    near = float((change.abs() < 0.4).float().mean())

    def within(bound, mean, std):
        def below(x):
            return 0.5 * (1.0 + math.erf((x - mean) / (std * math.sqrt(2.0))))

        return below(bound) - below(-bound)

    for bound in (0.4, 4.0):
        expected = (
            0.9 * within(bound, 0.0, 0.1)
            + 0.05 * within(bound, 0.0, 10.0)
            + 0.05 * within(bound, -1.0, 1.0)
        )
        found = float((change.abs() < bound).float().mean())
        assert abs(found - expected) < 0.005, bound
    small = change[change.abs() < 0.3]
    assert abs(float(small.std()) - 0.1) < 0.01
    assert near > 0.9


def test_usual_mutations_are_relative_and_zeros_only_change_by_resets():
    many = TensorDict(weight=torch.zeros(4000, 10, 10), batch_size=[4000])
    out = erl_mutation(many, generator=generator())["weight"]
    # 3/4 of the matrices, 4.5 of 100 weights on average, 5 % resets.
    assert abs(float((out != 0.0).float().mean()) - 0.75 * 0.045 * 0.05) < 2e-4
    assert abs(float(out[out != 0.0].std()) - 1.0) < 0.1


def test_vectors_do_not_mutate_and_arguments_stay():
    genomes = numbered(50, 8, 8)
    before = genomes.clone()
    out = erl_mutation(genomes, generator=generator())
    assert (genomes == before).all()
    assert (out["bias"] == genomes["bias"]).all()
    assert (out["net", "weight"] != genomes["net", "weight"]).any()


# Generations


def test_the_elites_of_erl_go_on_unchanged_and_first():
    population, order = numbered(6, 5, 5), torch.tensor([4, 2, 5, 1, 0, 3])
    following = next_erl_generation(
        population,
        order,
        num_elites=2,
        tournament_size=3,
        mutation_probability=0.9,
        generator=generator(),
    )
    assert following.batch_size == population.batch_size
    assert (following[:2] == population[torch.tensor([4, 2])]).all()
    assert (population == numbered(6, 5, 5)).all()


def test_without_mutation_the_children_of_erl_are_made_of_winners_and_elites():
    population, order = numbered(6, 5, 5), torch.tensor([4, 2, 5, 1, 0, 3])
    seen = set()
    for seed in range(40):
        following = next_erl_generation(
            population,
            order,
            num_elites=2,
            tournament_size=6,
            mutation_probability=0.0,
            generator=generator(seed),
        )
        children = following["net", "weight"][2:]
        assert (children == children[..., :1]).all(), "rows are whole"
        seen |= set(children.flatten().tolist())
    # Six drawn of six with replacement: nearly always one of the best three wins.
    assert seen <= {4.0, 2.0, 5.0, 1.0, 0.0}
    assert {4.0, 2.0} <= seen


@pytest.mark.parametrize("elites", [0, 6])
def test_there_must_be_elites_and_others(elites):
    with pytest.raises(ValueError, match="num_elites"):
        next_erl_generation(
            numbered(6, 2, 2),
            torch.arange(6),
            num_elites=elites,
            tournament_size=3,
            mutation_probability=0.9,
            generator=generator(),
        )


def test_the_plain_ga_keeps_the_elite_and_mutates_the_best():
    population, order = numbered(4001, 3, 3), torch.arange(4001).flip(0)
    following = next_truncated_generation(
        population,
        order,
        elite=7,
        num_parents=2,
        std=0.01,
        generator=generator(),
    )
    assert (following[0] == population[7]).all()
    weights = following["net", "weight"][1:]
    parent = weights.mean(dim=(1, 2)).round()
    assert set(parent.tolist()) == {4000.0, 3999.0}
    assert abs(float((parent == 4000.0).float().mean()) - 0.5) < 0.03
    noise = weights - parent[:, None, None]
    assert abs(float(noise.std()) - 0.01) < 2e-3
    assert (following["bias"][1:] != parent[:, None]).any(), "vectors mutate too"
