"""Averages against plain code and examples by hand."""

from __future__ import annotations

import numpy as np
import pytest

from gdrl_torchrl.reports.statistics.averages import (
    interquartile_mean,
    stratified_iqm,
    worst_quartile,
)


def plain_iqm(scores):
    ordered = sorted(scores)
    cut = len(ordered) // 4
    kept = ordered[cut : len(ordered) - cut]
    return sum(kept) / len(kept)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 10, 24])
def test_the_interquartile_mean_is_that_of_the_sorted_middle(count):
    scores = np.random.default_rng(count).random(count)
    assert interquartile_mean(scores) == pytest.approx(plain_iqm(scores), rel=1e-12)


def test_an_example_by_hand():
    # The lowest and the highest two of eight go; 5.5 is the mean of 4, 5, 6 and 7.
    assert interquartile_mean([100, 7, 4, -50, 6, 5, 1, 9]) == 5.5


def test_a_published_example():
    # Wikipedia, "Interquartile mean" (data set of twelve), where it is 6.5.
    assert interquartile_mean([5, 8, 4, 38, 8, 6, 9, 7, 7, 3, 1, 6]) == 6.5


def test_tasks_with_different_numbers_of_runs_are_averaged_as_one_list():
    first, second = [0.1, 0.9, 0.4], [0.3, 0.2, 0.8, 0.7, 0.6]
    together = stratified_iqm(np.array(first), np.array(second))
    assert together == pytest.approx(plain_iqm(first + second), rel=1e-12)


@pytest.mark.parametrize(
    ("count", "taken"), [(1, 1), (4, 1), (5, 2), (8, 2), (10, 3), (24, 6)]
)
def test_the_worst_quarter_is_rounded_up_to_whole_runs(count, taken):
    scores = np.arange(count, dtype=float)[::-1]
    assert worst_quartile(scores) == np.arange(taken).mean()
