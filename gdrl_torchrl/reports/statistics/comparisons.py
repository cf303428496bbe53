"""Whether the mean score of one method is above that of another, and by how much."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from scipy import optimize, stats

from gdrl_torchrl.reports.statistics.bootstrap import CONFIDENCE, Estimate

Alternative = Literal["greater", "less", "two-sided"]


def welch(
    x: np.ndarray, y: np.ndarray, alternative: Alternative = "greater"
) -> tuple[Estimate, float]:
    """Difference of means with its 95 % interval, and p (Welch 1947).

    Args:
        x: Scores ``[N]`` of the method that is thought to be better.
        y: Scores ``[M]`` of the other.
        alternative: What is tested against equal means; the interval is two-sided.

    Returns:
        The difference, and p: NaN where either has less than two runs, or no scatter in
        either leaves nothing to test by.

    Examples:
        >>> gain, p = welch(np.array([0.8, 0.9, 0.85]), np.array([0.5, 0.6, 0.55]))
        >>> round(gain.value, 2), round(gain.low, 2), round(gain.high, 2), round(p, 4)
        (0.3, 0.19, 0.41, 0.0009)
    """
    value = float(np.mean(x) - np.mean(y))
    if min(len(x), len(y)) < 2 or not (np.ptp(x) > 0.0 or np.ptp(y) > 0.0):
        return Estimate(value), math.nan
    test: Any = stats.ttest_ind(x, y, equal_var=False, alternative=alternative)
    both: Any = stats.ttest_ind(x, y, equal_var=False)
    low, high = both.confidence_interval(CONFIDENCE)
    return Estimate(value, float(low), float(high)), float(test.pvalue)


def permutation_p(
    x: np.ndarray,
    y: np.ndarray,
    alternative: Alternative = "greater",
    *,
    seed: int = 0,
    resamples: int = 20_000,
) -> float:
    """P of the difference of means when runs change methods at random.

    Exact where there are no more ways to divide the runs than ``resamples``.

    Examples:
        >>> permutation_p(np.array([0.8, 0.9, 0.7]), np.array([0.1, 0.2, 0.3]))
        0.05
    """
    result = stats.permutation_test(
        (x, y),
        lambda a, b, axis: np.mean(a, axis=axis) - np.mean(b, axis=axis),
        permutation_type="independent",
        vectorized=True,
        alternative=alternative,
        n_resamples=resamples,
        rng=np.random.default_rng(seed),
    )
    return float(result.pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """P values adjusted for their number (Holm 1979).

    A missing one (NaN) stays missing, and counts: leaving it out would make the others
    easier to reach.

    Examples:
        >>> [round(p, 3) for p in holm([0.01, 0.04, 0.03])]
        [0.03, 0.06, 0.06]
    """
    # No test counts as the weakest evidence.
    order = sorted(
        range(len(p_values)), key=lambda i: (math.isnan(p_values[i]), p_values[i])
    )
    adjusted, most = [math.nan] * len(p_values), 0.0
    for rank, index in enumerate(order):
        p = p_values[index]
        if not math.isnan(p):
            most = max(most, min(1.0, (len(p_values) - rank) * p))
            adjusted[index] = most
    return adjusted


def detectable_difference(
    x: np.ndarray,
    y: np.ndarray,
    alternative: Alternative = "greater",
    *,
    alpha: float = 0.05,
    power: float = 0.8,
) -> float:
    """Difference of means that Welch's test would find with a power, given this scatter.

    Args:
        x: Scores ``[N]`` of the one method; only their number and scatter count.
        y: Scores ``[M]`` of the other.
        alternative: What is tested against equal means.
        alpha: Level of the test; divided by the number of hypotheses for Holm's first.
        power: Probability of finding it.

    Returns:
        The difference, in units of the scores; NaN with less than two runs of either.

    Examples:
        >>> scores = 0.05 * np.tile([-1.0, 1.0], 12) * np.sqrt(23 / 24)
        >>> round(detectable_difference(scores, scores, "two-sided"), 3)
        0.041
    """
    if min(len(x), len(y)) < 2:
        return math.nan
    parts = np.array([np.var(s, ddof=1) / len(s) for s in (x, y)])
    error = math.sqrt(parts.sum())
    if error == 0.0:
        return 0.0
    freedom = parts.sum() ** 2 / (parts**2 / [len(x) - 1, len(y) - 1]).sum()
    tail = 0.5 * alpha if alternative == "two-sided" else alpha
    critical = stats.t.isf(tail, freedom)

    def missing(shift: float) -> float:
        return float(stats.nct.sf(critical, freedom, shift)) - power

    with warnings.catch_warnings():
        # The far tail of the noncentral distribution is rounded.
        warnings.simplefilter("ignore", RuntimeWarning)
        shift: Any = optimize.brentq(missing, 0.0, 10.0 * critical)
    return error * float(shift)
