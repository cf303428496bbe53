"""Curves of several runs on one axis."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gdrl_torchrl.reports.evidence import Run
from gdrl_torchrl.reports.statistics.averages import interquartile_mean
from gdrl_torchrl.reports.statistics.bootstrap import bootstrap_limits

_POINTS = 60
_RESAMPLES = 2000


@dataclasses.dataclass(frozen=True, eq=False)
class Band:
    """The interquartile mean of the success of runs with its 95 % interval.

    Attributes:
        x: What it cost, ``[G]``; only as far as every run has come.
        middle: The interquartile mean, ``[G]``.
        low: Lower limit, ``[G]``; NaN for a single run.
        high: Upper limit, ``[G]``.
    """

    x: np.ndarray
    middle: np.ndarray
    low: np.ndarray
    high: np.ndarray


def drawn(run: Run, cost: str) -> tuple[np.ndarray, np.ndarray]:
    """A run's curve over a cost, ``[K]`` each; one that failed has none."""
    x = run.curve.get(cost, np.empty(0))
    y = run.curve.get("success_rate", np.empty(0))
    known = np.isfinite(x) & np.isfinite(y)
    return x[known], y[known]


def band_of(runs: Sequence[Run], cost: str) -> Band | None:
    """The band of some runs over a cost; None where no cost is known of all of them.

    Runs are read between their points by straight lines. One that failed counts as 0 at
    every cost.

    Args:
        runs: Some runs.
        cost: One of :data:`~gdrl_torchrl.reports.evidence.COSTS`.
    """
    ended = [(x, y) for run in runs if not run.failed for x, y in [drawn(run, cost)]]
    if not ended or not all(len(x) for x, _ in ended):
        return None
    first, last = max(x[0] for x, _ in ended), min(x[-1] for x, _ in ended)
    if first >= last:
        return None
    grid = np.linspace(first, last, _POINTS)
    rows = [np.interp(grid, x, y) for x, y in ended]
    rows += [np.zeros_like(grid)] * (len(runs) - len(ended))
    values = np.stack(rows, axis=-1)
    low = high = np.full(_POINTS, np.nan)
    if len(rows) > 1:
        low, high = bootstrap_limits([values], interquartile_mean, resamples=_RESAMPLES)
    return Band(grid, interquartile_mean(values), low, high)
