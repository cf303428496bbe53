"""Bootstrap intervals that cover what they say with ten seeds too."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats

RESAMPLES = 5000
CONFIDENCE = 0.95


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval; the limits are NaN where too few runs give none."""

    value: float
    low: float = math.nan
    high: float = math.nan


def bootstrap_limits(
    strata: Sequence[np.ndarray],
    statistic: Callable[..., Any],
    *,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> tuple[np.ndarray, np.ndarray]:
    """95 % limits of a statistic by resampling runs within strata.

    Strata are the tasks (Agarwal et al. 2021, section 4.1), or the two methods that are
    compared. The plain percentile interval covers too little with few runs (about 0.88 to
    0.93 of 0.95 with five to ten). It is widened to the quantiles that make it Student's
    interval where the statistic is a mean and its distribution normal: the expanded
    percentile interval of Hesterberg (2015, section 5.3). The limits never leave the range
    of the scores.

    Args:
        strata: Scores ``[..., N]`` with at least two runs each; the leading axes are
            resampled together.
        statistic: Of the strata as arguments, and ``axis``, which it reduces.
        seed: Of the resampling.
        resamples: How many.

    Returns:
        Lower and upper limits, of the shape that ``statistic`` gives.

    Raises:
        ValueError: If a stratum has less than two runs.

    Examples:
        >>> scores = np.linspace(0.0, 1.0, 11)
        >>> low, high = bootstrap_limits([scores], np.mean)
        >>> round(float(low), 1), round(float(high), 1)
        (0.3, 0.7)
    """
    least = min(np.shape(scores)[-1] for scores in strata)
    if least < 2:
        raise ValueError(f"runs={least} must be at least 2 in every stratum")
    result = stats.bootstrap(
        tuple(strata),
        statistic,
        n_resamples=resamples,
        vectorized=True,
        axis=-1,
        confidence_level=expanded_confidence(least),
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    return result.confidence_interval


def expanded_confidence(num_runs: int, confidence: float = CONFIDENCE) -> float:
    """Confidence that the percentile interval is asked for, so that it has another one.

    Args:
        num_runs: Runs in the smallest stratum.
        confidence: The confidence that the interval shall have.

    Examples:
        >>> [round(expanded_confidence(n), 3) for n in (5, 10, 24, 1000)]
        [0.998, 0.983, 0.965, 0.95]
    """
    quantile = stats.t.ppf(0.5 + 0.5 * confidence, num_runs - 1)
    tail = stats.norm.cdf(-math.sqrt(num_runs / (num_runs - 1)) * quantile)
    return float(1.0 - 2.0 * tail)


def estimate(
    strata: Sequence[np.ndarray], statistic: Callable[..., Any], *, seed: int = 0
) -> Estimate:
    """A statistic of scores ``[N]`` of each stratum with its interval.

    Examples:
        >>> estimate([np.array([0.5])], np.mean)
        Estimate(value=0.5, low=nan, high=nan)
    """
    value = float(statistic(*strata, axis=-1))
    if min(len(scores) for scores in strata) < 2:
        return Estimate(value)
    low, high = bootstrap_limits(strata, statistic, seed=seed)
    return Estimate(value, float(low), float(high))
