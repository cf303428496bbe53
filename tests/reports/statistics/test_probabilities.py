"""Probabilities of improvement against Mann and Whitney's U, and their intervals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from gdrl_torchrl.reports.statistics.probabilities import (
    improvement,
    improvement_over_tasks,
    wilson_limits,
)


@pytest.mark.parametrize("decimals", [1, 8])
def test_improvement_is_u_over_the_number_of_pairs(decimals):
    rng = np.random.default_rng(4)
    # Rounded to tenths, there are many ties.
    x, y = rng.random(9).round(decimals), rng.random(14).round(decimals)
    u = stats.mannwhitneyu(x, y).statistic
    assert improvement(x, y) == pytest.approx(u / (9 * 14))
    assert improvement(y, x) == pytest.approx(1.0 - u / (9 * 14))


def coverage(count, shift):
    """Share of invented studies whose interval holds the truth."""
    rng = np.random.default_rng(count)
    truth = stats.norm.cdf(shift / np.sqrt(2.0))
    hits = []
    for _ in range(1000):
        x, y = rng.normal(shift, 1.0, count), rng.normal(0.0, 1.0, count)
        found = improvement_over_tasks([(x, y)])
        hits.append(found.low <= truth <= found.high)
    return np.mean(hits)


@pytest.mark.parametrize("count", [5, 10, 24])
@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_its_interval_covers_what_it_says(count, shift):
    assert 0.92 <= coverage(count, shift) <= 0.98


@pytest.mark.parametrize("count", [5, 10, 24])
@pytest.mark.parametrize("shift", [2.0, 3.0])
def test_near_certainty_its_interval_covers_no_less(count, shift):
    assert coverage(count, shift) >= 0.92


def test_its_interval_over_tasks_covers_what_it_says():
    rng = np.random.default_rng(0)
    truth = np.mean(stats.norm.cdf(np.array([0.0, 2.0]) / np.sqrt(2.0)))
    hits = []
    for _ in range(1000):
        tasks = [(rng.normal(s, 1.0, 10), rng.normal(0.0, 1.0, 10)) for s in (0.0, 2.0)]
        found = improvement_over_tasks(tasks)
        hits.append(found.low <= truth <= found.high)
    assert 0.92 <= np.mean(hits) <= 0.98


def test_runs_that_are_all_better_do_not_make_it_certain():
    found = improvement_over_tasks([(np.arange(5.0, 8.0), np.arange(3.0))])
    assert found.value == found.high == 1.0
    assert 0.2 < found.low < 0.7
    other = improvement_over_tasks([(np.arange(3.0), np.arange(5.0, 8.0))])
    assert (other.low, other.high) == pytest.approx((0.0, 1.0 - found.low))


@pytest.mark.parametrize("count", [3, 10])
def test_wilson_is_scipys(count):
    for hits in range(count + 1):
        test = stats.binomtest(hits, count).proportion_ci(0.95, "wilson")
        found = wilson_limits(hits / count, count)
        assert found == pytest.approx((test.low, test.high), abs=1e-9)
