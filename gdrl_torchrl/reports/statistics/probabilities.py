"""Probabilities over runs, with intervals that hold near 0 and 1 too.

A bootstrap interval has no width where every run of one method beats every run of the
other, which few runs do easily: these have formulas instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import optimize, stats

from gdrl_torchrl.reports.statistics.bootstrap import CONFIDENCE, Estimate

_Z = float(stats.norm.ppf(0.5 + 0.5 * CONFIDENCE))


def improvement(x: Any, y: Any) -> float:
    """Probability of improvement, P(X > Y) + P(X = Y) / 2 over all pairs of runs.

    It is the statistic U of Mann and Whitney over the number of pairs (Agarwal et al.
    2021, section 4.3).

    Args:
        x: Scores of runs of the one method, ``[N]``.
        y: Scores of runs of the other, ``[M]``.

    Examples:
        >>> improvement([0.5, 0.9], [0.5, 0.7])
        0.625
    """
    signs = np.sign(np.asarray(x)[:, None] - np.asarray(y)[None, :])
    return float(0.5 + 0.5 * signs.mean())


def improvement_over_tasks(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Estimate:
    """Mean over tasks of the probability of improvement, with its 95 % interval.

    The limits of a task solve ``(estimate - p)^2 = z^2 V(p)`` with the variance of
    Newcombe (2006, part 2, method 5); those of the mean follow from the tasks' distances to
    their limits, as squares (Zou and Donner 2008).

    Args:
        pairs: Scores ``[N]`` and ``[M]`` of the two methods, by task.

    Examples:
        >>> found = improvement_over_tasks([(np.arange(10.0) + 10.0, np.arange(10.0))])
        >>> round(found.value, 2), round(found.low, 2), round(found.high, 2)
        (1.0, 0.8, 1.0)
    """
    values = np.array([improvement(x, y) for x, y in pairs])
    sizes = [(len(x), len(y)) for x, y in pairs]
    both = list(zip(values, sizes, strict=True))
    low = np.array([_lower(value, *size) for value, size in both])
    high = np.array([1.0 - _lower(1.0 - value, *size) for value, size in both])
    middle, below, above = mean_with_limits(values, low, high)
    return Estimate(float(middle), float(below), float(above))


def wilson_limits(shares: Any, num_runs: int) -> tuple[Any, Any]:
    """95 % limits of probabilities (Wilson 1927).

    Args:
        shares: Shares of runs, any shape.
        num_runs: Of how many runs.

    Examples:
        >>> low, high = wilson_limits(np.array([0.5, 1.0]), 10)
        >>> low.round(2), high.round(2)
        (array([0.24, 0.72]), array([0.76, 1.  ]))
    """
    scale = 1.0 / (1.0 + _Z**2 / num_runs)
    centre = scale * (shares + 0.5 * _Z**2 / num_runs)
    spread = shares * (1.0 - shares) / num_runs + 0.25 * _Z**2 / num_runs**2
    half = scale * _Z * np.sqrt(spread)
    return np.maximum(centre - half, 0.0), np.minimum(centre + half, 1.0)


def mean_with_limits(values: Any, low: Any, high: Any) -> tuple[Any, Any, Any]:
    """Mean of independent estimates with limits from theirs (Zou and Donner 2008).

    Args:
        values: Estimates, ``[T, ...]``.
        low: Their lower limits, ``[T, ...]``.
        high: Their upper limits, ``[T, ...]``.

    Returns:
        The mean and its limits, ``[...]``.

    Examples:
        >>> values = np.array([0.2, 0.6])
        >>> np.round(mean_with_limits(values, values, np.array([0.5, 1.0])), 2)
        array([0.4 , 0.4 , 0.65])
    """
    middle = np.mean(values, axis=0)
    below = np.sqrt(np.sum((values - low) ** 2, axis=0)) / len(values)
    above = np.sqrt(np.sum((high - values) ** 2, axis=0)) / len(values)
    return middle, middle - below, middle + above


def _lower(value: float, n: int, m: int) -> float:
    """Lower limit of a probability of improvement from ``n`` and ``m`` runs."""
    if value == 0.0:
        return 0.0

    def beyond(p: float) -> float:
        runs = 0.5 * (n + m) - 1.0
        part = 1.0 + runs * ((1.0 - p) / (2.0 - p) + p / (1.0 + p))
        return (value - p) ** 2 - _Z**2 * p * (1.0 - p) * part / (n * m)

    # One is a root as well if it is the estimate, and not the one looked for.
    limit: Any = optimize.brentq(beyond, 0.0, min(value, math.nextafter(1.0, 0.0) - 1e-9))
    return float(limit)
