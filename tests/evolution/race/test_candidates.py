"""Candidates of a race: who is kept, who plays, who is tested."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from gdrl_torchrl.evolution.race.candidates import Candidate, Candidates


def candidate(successes, episodes, number=0):
    return Candidate(TensorDict(n=torch.tensor(float(number))), "new", successes, episodes)


records = st.lists(
    st.tuples(st.integers(0, 6), st.integers(0, 6)).map(lambda r: (r[0], sum(r))),
    max_size=8,
)


@given(records=records, most=st.integers(1, 4))
def test_the_best_that_have_succeeded_are_kept(records, most):
    candidates = Candidates(most)
    everyone = [candidate(*record) for record in records]
    for one in everyone:
        candidates.keep([one])
        candidates.keep([one])
    worth = {id(c): (c.successes + 0.5) / (c.episodes + 1.5) for c in everyone}
    good = sorted((worth[id(c)] for c in everyone if c.successes), reverse=True)
    assert [worth[id(c)] for c in candidates.kept] == good[:most]
    assert len({id(c) for c in candidates.kept}) == len(candidates)


@given(records=records, least=st.floats(0.05, 1.0))
def test_promising_is_who_succeeds_again_often_enough(records, least):
    candidates = Candidates(8)
    candidates.keep(candidate(*record) for record in records)
    best = None
    for one in candidates.kept:
        # The first success and its episode are not counted.
        won, played = one.successes - 1, one.episodes - 1
        enough = won >= 2 and won / played >= least
        if enough and (best is None or won / (played + 1) > best):
            best = won / (played + 1)
    found = candidates.promising(least)
    assert (found is None) == (best is None)
    if found is not None:
        assert (found.successes - 1) / found.episodes == best


def test_good_ones_play_again_and_new_ones_where_nothing_is_good():
    rng = np.random.default_rng(0)
    shares = []
    for record in ((9, 10), (1, 30)):
        candidates = Candidates(4)
        candidates.keep([candidate(*record)])
        drawn = [candidates.draw(rng) for _ in range(400)]
        shares.append(sum(one is not None for one in drawn) / 400)
    assert shares[0] > 0.95
    assert shares[1] < 0.75
    assert Candidates(4).draw(rng) is None


def test_the_share_of_new_ones_is_that_of_the_two_distributions():
    candidates = Candidates(1)
    candidates.keep([candidate(2, 5)])
    rng = np.random.default_rng(1)
    share = np.mean([candidates.draw(rng) is None for _ in range(4000)])
    # P(beta(0.2, 2) > beta(2.5, 4.5)) by sums over a fine grid.
    grid = (np.arange(200_000) + 0.5) / 200_000
    new, old = (grid ** (a - 1) * (1 - grid) ** (b - 1) for a, b in ((0.2, 2), (2.5, 4.5)))
    expected = (new * np.cumsum(old)).sum() / (new.sum() * old.sum())
    assert share == pytest.approx(expected, abs=0.02)


def test_who_plays_already_is_not_drawn():
    candidates = Candidates(4)
    candidates.keep([candidate(9, 9), candidate(8, 8)])
    rng, busy = np.random.default_rng(0), [candidates.kept[0]]
    drawn = {id(candidates.draw(rng, busy)) for _ in range(200)}
    assert id(busy[0]) not in drawn
    assert id(candidates.kept[1]) in drawn


def test_its_state_is_all_of_it():
    candidates = Candidates(4)
    candidates.keep([candidate(3, 4, 1), candidate(1, 1, 2)])
    other = Candidates(4)
    other.load_state_dict(candidates.state_dict())
    assert [(c.successes, c.episodes, c.origin) for c in other.kept] == [
        (c.successes, c.episodes, c.origin) for c in candidates.kept
    ]
    assert [float(c.genome["n"]) for c in other.kept] == [
        float(c.genome["n"]) for c in candidates.kept
    ]
    other.load_state_dict(Candidates(4).state_dict())
    assert len(other) == 0
