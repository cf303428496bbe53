"""What it took to reach a threshold, where not every run did."""

from __future__ import annotations

import dataclasses
import math
import warnings

import numpy as np
from scipy import stats

from gdrl_torchrl.reports.statistics.bootstrap import CONFIDENCE, Estimate


@dataclasses.dataclass(frozen=True)
class Crossing:
    """When a run reached a threshold; or, if it did not, how far it was watched.

    One that failed is watched for ever, and will never get there.
    """

    at: float
    reached: bool


def crossing(x: np.ndarray, success: np.ndarray, threshold: float) -> Crossing:
    """The first point of a curve at or above a threshold.

    Args:
        x: What the points cost, ascending, ``[K]``.
        success: Success at them, ``[K]``.
        threshold: From 0 to 1.

    Examples:
        >>> x = np.array([10.0, 20.0, 30.0])
        >>> crossing(x, np.array([0.2, 0.85, 0.7]), 0.8)
        Crossing(at=20.0, reached=True)
        >>> crossing(x, np.array([0.2, 0.85, 0.7]), 0.9)
        Crossing(at=30.0, reached=False)
    """
    above = np.flatnonzero(success >= threshold)
    if len(above):
        return Crossing(float(x[above[0]]), reached=True)
    return Crossing(float(x[-1]), reached=False)


def median_time(crossings: list[Crossing]) -> Estimate:
    """Median of the times to a threshold with runs that never got there.

    The estimator of Kaplan and Meier (1958). The limits are where its 95 % band in
    log-log scale passes one half (Brookmeyer and Crowley 1982).

    Returns:
        Infinite where less than half of the runs got there, as far as they were watched.

    Examples:
        >>> median_time([Crossing(10.0, True), Crossing(20.0, True), Crossing(50.0, False)])
        Estimate(value=20.0, low=10.0, high=inf)
    """
    reached = [crossing.at for crossing in crossings if crossing.reached]
    if not reached:
        return Estimate(math.inf, math.nan, math.inf)
    # How far beyond the last one that got there makes no difference, and must be finite.
    watched = [min(c.at, max(reached) + 1.0) for c in crossings if not c.reached]
    data = stats.CensoredData(uncensored=reached, right=watched)
    survival = stats.ecdf(data).sf
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # Where all or none have arrived the band has no width: it is NaN there.
        warnings.simplefilter("ignore", RuntimeWarning)
        band = survival.confidence_interval(CONFIDENCE, method="log-log")
    times, left = survival.quantiles, survival.probabilities
    # Nothing is below 0, which is what is left when the last one has arrived.
    low = np.where(left > 0.0, band.low.probabilities, 0.0)
    return Estimate(
        _first(times, left),
        _first(times, low),
        _first(times, band.high.probabilities),
    )


def _first(times: np.ndarray, left: np.ndarray) -> float:
    """First time at which at most half are left; infinite if there is none."""
    # Rounding of 1 - 1 / 2, say, must not matter.
    at = np.flatnonzero(left <= 0.5 + 1e-12)
    return float(times[at[0]]) if len(at) else math.inf
