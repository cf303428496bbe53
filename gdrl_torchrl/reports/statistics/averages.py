"""Averages over seeds: of the middle half, and of the worst quarter."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import stats


def interquartile_mean(scores: Any, axis: int = -1) -> Any:
    """Mean without the lowest and the highest quarter (Agarwal et al. 2021, section 4.3).

    Of ``n`` scores ``floor(n / 4)`` are left out at either end, as rliable does.

    Args:
        scores: Scores of runs, any shape.
        axis: The axis over runs, which goes.

    Returns:
        As ``scores`` without that axis.

    Examples:
        >>> float(interquartile_mean([0.0, 0.5, 0.7, 1.0]))
        0.6
    """
    return stats.trim_mean(scores, 0.25, axis=axis)


def stratified_iqm(*strata: np.ndarray, axis: int = -1) -> Any:
    """Interquartile mean of all runs of all tasks together.

    Args:
        strata: Scores of the runs of each task, ``[..., N]`` with an ``N`` of its own.
        axis: The axis over runs.

    Examples:
        >>> float(stratified_iqm(np.array([0.0, 1.0]), np.array([0.5, 0.7])))
        0.6
    """
    return interquartile_mean(np.concatenate(strata, axis=axis), axis=axis)


def worst_quartile(scores: Any) -> float:
    """Mean of the lowest quarter of scores ``[N]``, rounded up to whole runs.

    It is the conditional value at risk at 0.25 (Patterson et al. 2024, section 4.4).

    Examples:
        >>> worst_quartile([0.9, 0.1, 0.8, 0.3, 1.0])
        0.2
    """
    lowest = np.sort(np.asarray(scores, dtype=np.float64))
    return float(lowest[: math.ceil(len(lowest) / 4)].mean())
