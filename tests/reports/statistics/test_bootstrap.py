"""Intervals: against plain code, and whether they cover what they say."""

from __future__ import annotations

import random

import numpy as np
import pytest
from scipy import stats

from gdrl_torchrl.reports.statistics.averages import interquartile_mean, stratified_iqm
from gdrl_torchrl.reports.statistics.bootstrap import (
    bootstrap_limits,
    estimate,
    expanded_confidence,
)

STUDIES = 1000


def plain_limits(strata, confidence, resamples):
    """The percentile interval of the interquartile mean, run by run."""
    rng = random.Random(5)
    found = []
    for _ in range(resamples):
        drawn = sorted(x for scores in strata for x in rng.choices(scores, k=len(scores)))
        cut = len(drawn) // 4
        kept = drawn[cut : len(drawn) - cut]
        found.append(sum(kept) / len(kept))
    found.sort()
    tail = int(resamples * (1.0 - confidence) / 2.0)
    return found[tail], found[-1 - tail]


def test_limits_are_those_of_a_plain_stratified_bootstrap():
    rng = np.random.default_rng(3)
    strata = [rng.beta(8, 2, 10), rng.beta(2, 2, 10)]
    # Student's t for ten runs is 2.2622: the normal tail beyond 2.2622 sqrt(10 / 9).
    tail = 1.0 - stats.norm.cdf(2.2622 * (10.0 / 9.0) ** 0.5)
    expected = plain_limits([list(s) for s in strata], 1.0 - 2.0 * tail, 20_000)
    found = bootstrap_limits(strata, stratified_iqm, resamples=20_000)
    assert found[0] == pytest.approx(expected[0], abs=0.004)
    assert found[1] == pytest.approx(expected[1], abs=0.004)


def test_the_interval_of_a_mean_of_many_is_students():
    scores = np.random.default_rng(0).normal(0.5, 0.1, 200)
    low, high = bootstrap_limits([scores], np.mean)
    test = stats.ttest_1samp(scores, 0.5).confidence_interval(0.95)
    assert (low, high) == pytest.approx((test.low, test.high), abs=0.002)


def invented(kind, count):
    """Scores of many studies ``[STUDIES, count]``, and the truth."""
    rng = np.random.default_rng(count)
    draw = {
        "normal": lambda shape: rng.normal(0.6, 0.15, shape),
        "near the ceiling": lambda shape: rng.beta(20, 1, shape),
        "some seeds fail": lambda shape: np.where(
            rng.random(shape) < 0.3, rng.beta(2, 8, shape), rng.beta(20, 1, shape)
        ),
    }[kind]
    return draw((STUDIES, count)), interquartile_mean(draw(400_000))


def coverage(scores, truth):
    """Share of studies whose interval holds the truth."""
    hits = []
    for k in range(0, STUDIES, 250):
        low, high = bootstrap_limits(
            [scores[k : k + 250]], interquartile_mean, seed=k, resamples=800
        )
        hits.append((low <= truth) & (truth <= high))
    return np.mean(hits)


KINDS = ["normal", "near the ceiling", "some seeds fail"]


@pytest.mark.parametrize("count", [10, pytest.param(24, marks=pytest.mark.full)])
@pytest.mark.parametrize("kind", KINDS)
def test_intervals_of_ten_and_more_seeds_cover_what_they_say(kind, count):
    assert 0.92 <= coverage(*invented(kind, count)) <= 0.98


@pytest.mark.parametrize(
    ("kind", "least", "most"),
    [
        ("normal", 0.91, 0.97),
        ("near the ceiling", 0.91, 0.97),
        ("some seeds fail", 0.85, 0.92),
    ],
)
def test_five_seeds_cover_less_where_some_fail_as_the_guide_says(kind, least, most):
    assert least <= coverage(*invented(kind, 5)) <= most


def test_a_plain_percentile_interval_would_cover_less():
    scores, _ = invented("normal", 10)
    wide = bootstrap_limits([scores[0]], np.mean)
    plain = stats.bootstrap(
        (scores[0],), np.mean, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    assert wide[1] - wide[0] > 1.1 * (plain.high - plain.low)
    assert expanded_confidence(10) > 0.95


def test_the_same_seed_gives_the_same_interval_and_another_nearly_the_same():
    scores = [np.random.default_rng(1).random(10)]
    first, again, other = (estimate(scores, np.mean, seed=s) for s in (0, 0, 1))
    assert first == again
    assert first != other
    assert first.low == pytest.approx(other.low, abs=0.02)


def test_equal_scores_have_an_interval_without_width():
    found = estimate([np.full(6, 0.75)], interquartile_mean)
    assert (found.low, found.value, found.high) == (0.75, 0.75, 0.75)


def test_one_run_is_no_stratum():
    with pytest.raises(ValueError, match="runs=1 must be at least 2"):
        bootstrap_limits([np.array([0.5])], np.mean)
