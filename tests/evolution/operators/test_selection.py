"""Selection against a brute force over small tables of scores."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from gdrl_torchrl.evolution.operators.selection import TIE_RULES, rank_scores, select_best

NAN = float("nan")
SCORES = st.sampled_from([NAN, 0.0, 1.0, 2.0])
TABLES = st.integers(1, 5).flatmap(
    lambda size: st.tuples(
        st.lists(SCORES, min_size=size, max_size=size),
        st.lists(SCORES, min_size=size, max_size=size),
        st.integers(0, size - 1),
    )
)


def table(fitness, returns=None):
    returns = [0.0] * len(fitness) if returns is None else returns
    return TensorDict(
        fitness=torch.tensor(fitness),
        return_mean=torch.tensor(returns),
        batch_size=[len(fitness)],
    )


def number(score):
    return -math.inf if math.isnan(score) else score


def brute_force(fitness, returns, parent, rule):
    """Sort members by what the rule says; the first one wins."""
    alive = [i for i, score in enumerate(fitness) if not math.isnan(score)]
    if not alive:
        return parent
    orders = {
        "return_then_parent": lambda i: (-fitness[i], -number(returns[i]), i != parent, i),
        "parent": lambda i: (-fitness[i], i != parent, i),
        "child": lambda i: (-fitness[i], i == parent, i),
    }
    return min(alive, key=orders[rule])


@pytest.mark.parametrize("rule", TIE_RULES)
@given(scores=TABLES)
def test_every_tie_rule_agrees_with_a_brute_force(rule, scores):
    fitness, returns, parent = scores
    winner = select_best(table(fitness, returns), parent=parent, tie_rule=rule)
    assert winner == brute_force(fitness, returns, parent, rule)


@pytest.mark.parametrize("rule", TIE_RULES)
@given(scores=TABLES)
def test_nan_never_wins_over_a_number(rule, scores):
    fitness, returns, parent = scores
    winner = select_best(table(fitness, returns), parent=parent, tie_rule=rule)
    if any(not math.isnan(score) for score in fitness):
        assert not math.isnan(fitness[winner])
    else:
        assert winner == parent


@pytest.mark.parametrize("rule", TIE_RULES)
@given(
    fitness=st.lists(st.integers(-9, 9), min_size=2, max_size=6, unique=True),
    data=st.data(),
)
def test_without_ties_the_order_of_members_does_not_matter(rule, fitness, data):
    order = data.draw(st.permutations(range(len(fitness))))
    scores = table([float(f) for f in fitness])
    shuffled = select_best(scores[list(order)], parent=order.index(0), tie_rule=rule)
    assert order[shuffled] == select_best(scores, parent=0, tie_rule=rule)


def test_the_tie_rules_differ_where_they_should():
    scores = table([5.0, 5.0, 4.0], [0.1, 0.2, 9.0])
    assert select_best(scores) == 1
    assert select_best(scores, tie_rule="parent") == 0
    assert select_best(scores, tie_rule="child") == 1
    equal = table([5.0, 5.0, 5.0], [0.2, 0.2, 0.2])
    assert select_best(equal) == 0
    assert select_best(equal, tie_rule="child") == 1


def test_a_better_child_wins_under_every_rule():
    scores = table([4.0, 5.0], [9.0, 0.0])
    assert {select_best(scores, tie_rule=rule) for rule in TIE_RULES} == {1}


def test_nan_returns_do_not_break_ties():
    assert select_best(table([5.0, 5.0], [NAN, 0.0])) == 1
    assert select_best(table([5.0, 5.0], [NAN, NAN])) == 0


def test_scores_of_an_integer_type_are_ranked_too():
    scores = table([1, 3, 2])
    assert select_best(scores) == 1


def test_ranked_scores_keep_their_order():
    ranked = rank_scores(torch.tensor([NAN, -1.0, NAN, 3.0]))
    assert ranked.tolist() == [-math.inf, -1.0, -math.inf, 3.0]


def test_an_unknown_rule_is_named():
    with pytest.raises(ValueError, match="tie_rule='best'"):
        select_best(table([1.0]), tie_rule="best")
