"""Tests of differences against scipy, textbooks and counting."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from gdrl_torchrl.reports.statistics.comparisons import (
    detectable_difference,
    holm,
    permutation_p,
    welch,
)


def test_welch_is_the_textbooks():
    x, y = np.array([27.5, 21.0, 19.0, 23.6, 17.0]), np.array([27.1, 22.0, 20.8, 23.4])
    parts = [np.var(s, ddof=1) / len(s) for s in (x, y)]
    error = math.sqrt(sum(parts))
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 4 + parts[1] ** 2 / 3)
    t = (x.mean() - y.mean()) / error
    found, p = welch(x, y, "two-sided")
    assert p == pytest.approx(2.0 * stats.t.sf(abs(t), freedom), rel=1e-9)
    half = stats.t.ppf(0.975, freedom) * error
    assert found.value == pytest.approx(x.mean() - y.mean())
    assert (found.low, found.high) == pytest.approx(
        (found.value - half, found.value + half)
    )


def test_the_three_alternatives_differ_as_they_must():
    rng = np.random.default_rng(0)
    x, y = rng.normal(0.6, 0.1, 10), rng.normal(0.5, 0.1, 10)
    both, more, less = (welch(x, y, a)[1] for a in ("two-sided", "greater", "less"))
    assert both == pytest.approx(2.0 * more)
    assert less == pytest.approx(1.0 - more)


@pytest.mark.parametrize("y", [[0.5, 0.5, 0.5], [0.5]])
def test_what_cannot_be_tested_has_a_difference_and_no_p(y):
    found, p = welch(np.array([0.75, 0.75, 0.75]), np.array(y))
    assert found.value == 0.25
    assert math.isnan(found.low)
    assert math.isnan(p)


@pytest.mark.parametrize("alternative", ["greater", "less", "two-sided"])
def test_the_permutation_test_counts_all_ways_to_divide_the_runs(alternative):
    x, y = [0.9, 0.4, 0.8, 0.75], [0.3, 0.5, 0.2]
    everything, seen = x + y, np.mean(x) - np.mean(y)
    differences = np.array(
        [
            np.mean(chosen) - (sum(everything) - sum(chosen)) / len(y)
            for chosen in itertools.combinations(everything, len(x))
        ]
    )
    more = np.mean(differences >= seen - 1e-12)
    less = np.mean(differences <= seen + 1e-12)
    expected = {"greater": more, "less": less, "two-sided": min(1.0, 2.0 * min(more, less))}
    found = permutation_p(np.array(x), np.array(y), alternative)
    assert found == pytest.approx(expected[alternative])


def test_holm_by_hand():
    # In order 0.005, 0.011, 0.02, 0.04, 0.13: times 5, 4, 3, 2 and 1, never falling.
    adjusted = holm([0.04, 0.011, 0.13, 0.005, 0.02])
    assert adjusted == pytest.approx([0.08, 0.044, 0.13, 0.025, 0.06])


def test_holm_never_falls_and_never_passes_one():
    assert holm([0.5, 0.4, 0.01]) == pytest.approx([0.8, 0.8, 0.03])
    assert holm([0.9, 0.8]) == [1.0, 1.0]


def test_a_test_that_is_missing_makes_the_others_no_easier():
    adjusted = holm([0.02, math.nan, 0.03])
    assert adjusted[0] == pytest.approx(0.06)
    assert math.isnan(adjusted[1])
    assert adjusted[2] == pytest.approx(0.06)


@pytest.mark.parametrize("alternative", ["greater", "two-sided"])
def test_the_detectable_difference_is_found_as_often_as_it_says(alternative):
    rng = np.random.default_rng(2)
    x, y = rng.normal(0.0, 0.05, (2, 4000, 17))
    given = np.tile([-1.0, 1.0], 9)[:17]
    given = 0.05 * (given - given.mean()) / np.std(given, ddof=1)
    least = detectable_difference(given, given, alternative)
    p = stats.ttest_ind(
        x + least, y, axis=1, equal_var=False, alternative=alternative
    ).pvalue
    assert np.mean(p < 0.05) == pytest.approx(0.8, abs=0.025)


def test_seventeen_seeds_find_a_difference_of_one_standard_deviation():
    # As tables of the power of a two-sided test say: 17 an arm for 0.8.
    given = np.tile([-1.0, 1.0], 9)
    seventeen = (given[:17] - given[:17].mean()) / np.std(given[:17], ddof=1)
    sixteen = given[:16] / np.std(given[:16], ddof=1)
    assert detectable_difference(seventeen, seventeen, "two-sided") <= 1.0
    assert detectable_difference(sixteen, sixteen, "two-sided") > 1.0


@pytest.mark.parametrize("alpha", [0.05, 0.001])
def test_two_runs_can_find_only_what_is_large(alpha):
    given = np.array([0.4, 0.5])
    found = detectable_difference(given, given, alpha=alpha)
    assert 0.2 < found < math.inf
    assert math.isnan(detectable_difference(given[:1], given))
