"""The champion: a test against it, and the way back."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from gdrl_torchrl.evolution.race.champion import Champion


def fisher(won, played, other_won, other_played):
    """P(the first has so many of all successes or more), counted."""
    total, successes = played + other_played, won + other_won
    ways = [
        math.comb(played, k) * math.comb(other_played, successes - k)
        for k in range(won, min(played, successes) + 1)
        if successes - k <= other_played
    ]
    return sum(ways) / math.comb(total, successes)


def champion_of(won, played, level=0.02):
    champion = Champion(nn.Linear(2, 2), level=level)
    champion.crown(won, played)
    return champion


@given(st.data())
def test_the_test_is_fishers(data):
    played, other = data.draw(st.integers(1, 30)), data.draw(st.integers(1, 50))
    won, other_won = data.draw(st.integers(0, played)), data.draw(st.integers(0, other))
    level = data.draw(st.sampled_from([0.0, 0.01, 0.05, 0.3]))
    p_value = fisher(won, played, other_won, other)
    if not math.isclose(p_value, level, rel_tol=1e-6):
        champion = champion_of(won, played, level)
        assert champion.is_better_than(other_won, other) == (p_value < level)


@pytest.mark.parametrize("success", [0.2, 0.5, 0.9])
def test_an_agent_that_is_as_good_is_seldom_called_worse(success):
    """Summed over all outcomes of both: at most the level."""
    level, played, other = 0.02, 12, 30

    def chance(k, n):
        return math.comb(n, k) * success**k * (1.0 - success) ** (n - k)

    wrong = sum(
        chance(won, played) * chance(other_won, other)
        for won in range(played + 1)
        for other_won in range(other + 1)
        if champion_of(won, played, level).is_better_than(other_won, other)
    )
    assert wrong <= level


def test_the_way_back_restores_every_weight_and_counts_what_came_of_it():
    actor = nn.Linear(3, 2)
    champion = Champion(actor, level=0.02)
    assert not champion
    champion.crown(6, 8)
    before = {name: p.clone() for name, p in actor.named_parameters()}
    objects = list(actor.parameters())
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(3.0)
    champion.return_to(1, 20)
    assert all(torch.equal(p, before[name]) for name, p in actor.named_parameters())
    assert [id(p) for p in actor.parameters()] == [id(p) for p in objects]
    assert (champion.successes, champion.episodes) == (7, 28)
    # Who is overrated falls back once; then the record says what to expect.
    assert not champion.is_better_than(1, 20)


def test_its_state_is_all_of_it():
    actor = nn.Linear(3, 2)
    champion, other = (Champion(actor, level=0.02) for _ in range(2))
    champion.crown(6, 8)
    before = actor.weight.detach().clone()
    other.load_state_dict(champion.state_dict())
    with torch.no_grad():
        actor.weight.zero_()
    other.return_to(0, 0)
    assert torch.equal(actor.weight, before)
    assert (other.successes, other.episodes) == (6, 8)
