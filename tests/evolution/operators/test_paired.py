"""The paired test: exact p-values, its level under the null, and the plan of halving."""

from __future__ import annotations

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gdrl_torchrl.evolution.operators.paired import (
    HalvingPlan,
    better_half,
    sign_flip_p_value,
)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def brute_force(values):
    values = [v for v in values if v != 0]
    if not values:
        return 1.0
    observed = sum(values)
    sums = [
        sum(sign * value for sign, value in zip(signs, values, strict=True))
        for signs in itertools.product((1, -1), repeat=len(values))
    ]
    return sum(total >= observed for total in sums) / len(sums)


@given(values=st.lists(st.integers(-3, 3), max_size=9))
def test_p_values_of_few_differences_are_exact(values):
    found = sign_flip_p_value(
        torch.tensor(values, dtype=torch.float32), generator=generator()
    )
    assert found == pytest.approx(brute_force(values), abs=1e-12)


def test_p_values_of_many_differences_are_near_the_exact_ones():
    torch.manual_seed(2)
    for shift in (-0.3, 0.0, 0.3, 0.6):
        values = torch.randn(13) + shift
        # 8,192 patterns: exact by brute force, drawn by the function.
        signs = torch.tensor(list(itertools.product((1.0, -1.0), repeat=13)))
        exact = float((signs @ values >= values.sum() - 1e-6).double().mean())
        drawn = sign_flip_p_value(values, generator=generator(), num_draws=20_000)
        assert abs(drawn - exact) < 0.015


@given(values=st.lists(st.floats(-5, 5), min_size=1, max_size=40))
@settings(max_examples=40)
def test_p_values_are_probabilities_and_never_zero(values):
    found = sign_flip_p_value(torch.tensor(values), generator=generator())
    assert 0.0 < found <= 1.0


def test_what_is_not_a_number_proves_nothing():
    values = torch.tensor([9.0, 9.0, 9.0, 9.0, float("nan")])
    assert sign_flip_p_value(values, generator=generator()) == 1.0


@pytest.mark.parametrize("level", [0.05, 0.2])
@pytest.mark.parametrize("chance", [0.1, 0.5, 0.9])
def test_equal_members_are_told_apart_no_more_often_than_the_level(level, chance):
    rng, wrong, trials = generator(3), 0, 1500
    for _ in range(trials):
        child, parent = (torch.rand(2, 20, generator=rng) < chance).float()
        wrong += sign_flip_p_value(child - parent, generator=rng) <= level
    # Three standard errors.
    assert wrong / trials <= level + 3 * (level * (1 - level) / trials) ** 0.5


@given(
    scores=st.lists(
        st.sampled_from([float("nan"), 0.0, 1.0, 2.0, 3.0]), min_size=1, max_size=9
    )
)
def test_no_one_in_the_worse_half_beats_one_in_the_better(scores):
    kept = better_half(torch.tensor(scores)).tolist()
    assert kept == sorted(set(kept))
    assert len(kept) == (len(scores) + 1) // 2
    rank = [-1.0 if s != s else s for s in scores]
    dropped = [rank[i] for i in range(len(scores)) if i not in kept]
    assert not dropped or max(dropped) <= min(rank[i] for i in kept)


@pytest.mark.parametrize("children", [1, 2, 3, 10, 64])
def test_rounds_halve_until_one_is_left(children):
    alive = children
    for count, trials in HalvingPlan(screening_trials=4).rounds(children):
        assert (count, trials) == (alive, 4)
        alive = (alive + 1) // 2
    assert alive == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [("screening_trials", 0), ("test_trials", 0), ("num_looks", 0), ("level", 0.0)],
)
def test_plans_that_cannot_be_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        HalvingPlan(**{name: value})
