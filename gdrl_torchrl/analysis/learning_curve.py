"""The figure of how a run learned."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter

from gdrl_torchrl.analysis import style

# Column of metrics.csv, its label, what one tick is worth, and the panel's width.
_COSTS = (
    ("total_steps", "environment steps, agent and population", 1.0, 2.0),
    ("agent_steps", "steps of the agent", 1.0, 1.0),
    ("wall_s", "wall time (min)", 60.0, 1.0),
)
COLUMNS = ("agent_steps", "total_steps", "wall_s", "success_rate", "mut_p", "switched")
"""What is drawn of a run's metrics."""


def make_learning_curve(
    metrics: dict[str, np.ndarray], evaluation: dict[str, Any] | None = None
) -> Figure:
    """Make the figure of success rate over all that it cost.

    Args:
        metrics: Columns ``[R]`` of :func:`~gdrl_torchrl.analysis.run_files.read_metrics`.
        evaluation: Held-out evaluation, if there was one.

    Returns:
        One column of panels per cost: success rate and, if there were genetic
        evaluations, mutation probability below it.
    """
    is_evaluation = evaluation_rows(metrics)
    num_rows = 2 if is_evaluation.any() else 1
    figure = style.new_figure(11.0, 3.2 + 1.4 * num_rows, layout="constrained")
    panels = figure.subplots(
        num_rows,
        len(_COSTS),
        sharex="col",
        sharey="row",
        squeeze=False,
        width_ratios=[width for *_, width in _COSTS],
        height_ratios=[3.0, 1.0][:num_rows],
    )
    for column, (cost, label, unit, _) in enumerate(_COSTS):
        top = panels[0, column]
        x = metrics[cost] / unit
        known = np.isfinite(metrics["success_rate"])
        top.plot(x[known], metrics["success_rate"][known], color=style.BLUE, lw=1.6)
        if num_rows == 2:
            _draw_evaluations(top, panels[1, column], x, metrics)
        if evaluation is not None:
            _draw_held_out(top, evaluation[cost] / unit, evaluation)
        for axes in panels[:, column]:
            style.quiet(axes)
        panels[-1, column].set_xlabel(label, fontsize=10)
        panels[-1, column].xaxis.set_major_locator(MaxNLocator(6 if column == 0 else 4))
        panels[-1, column].set_xlim(left=0.0)
        if unit == 1.0:
            panels[-1, column].xaxis.set_major_formatter(EngFormatter(sep=""))
    panels[0, 0].set_ylim(-0.02, 1.05)
    panels[0, 0].yaxis.set_major_formatter(PercentFormatter(1.0))
    panels[0, 0].set_ylabel("success rate", fontsize=10)
    if num_rows == 2:
        panels[1, 0].set_ylim(0.0, 1.0)
        panels[1, 0].set_ylabel("mutation\nprobability", fontsize=10)
    _add_legend(figure, metrics, evaluation)
    if evaluation is not None:
        title = "{algorithm} on {task}, seed {seed}".format_map(evaluation)
        # A dollar sign in a name does not begin a formula.
        figure.suptitle(title, fontsize=12, color=style.INK, parse_math=False)
    return figure


def evaluation_rows(metrics: dict[str, np.ndarray]) -> np.ndarray:
    """Mask of the rows of training that ended with a genetic evaluation, ``[R]``."""
    return np.isfinite(
        metrics.get("switched", np.full(len(metrics["total_steps"]), np.nan))
    )


def wilson_interval(rate: float, count: int) -> tuple[float, float]:
    """95 % interval of a probability (Wilson 1927), from its rate over ``count`` trials.

    Examples:
        >>> low, high = wilson_interval(0.5, 100)
        >>> round(low, 3), round(high, 3)
        (0.404, 0.596)
    """
    z = 1.959964
    scale = 1.0 / (1.0 + z * z / count)
    centre = scale * (rate + 0.5 * z * z / count)
    half = scale * z * np.sqrt(rate * (1.0 - rate) / count + 0.25 * z * z / count**2)
    return float(max(centre - half, 0.0)), float(min(centre + half, 1.0))


def _draw_evaluations(
    top: Axes, bottom: Axes, x: np.ndarray, metrics: dict[str, np.ndarray]
) -> None:
    """Mark switches in the upper panel; steps of the mutation probability below."""
    rows = evaluation_rows(metrics)
    switched = rows & (metrics["switched"] > 0.5)
    kept = rows & ~switched
    probability = metrics["mut_p"]
    for at in x[switched]:
        top.axvline(at, color=style.GREEN, lw=0.8, alpha=0.35, zorder=1)
    # The probability holds until the next evaluation finds another one.
    edges, values = np.append(x[rows], x[-1]), probability[rows]
    bottom.step(edges, np.append(values, values[-1]), where="post", color="#b0b0b0", lw=1.2)
    bottom.plot(
        x[kept],
        probability[kept],
        ls="none",
        marker="o",
        ms=4.5,
        mfc="white",
        mec=style.GREY,
    )
    bottom.plot(
        x[switched], probability[switched], ls="none", marker="^", ms=6, color=style.GREEN
    )


def _draw_held_out(axes: Axes, x: float, evaluation: dict[str, Any]) -> None:
    rate = evaluation["success_rate"]
    low, high = wilson_interval(rate, evaluation["episodes"])
    axes.errorbar(
        x,
        rate,
        yerr=[[max(rate - low, 0.0)], [max(high - rate, 0.0)]],
        marker="D",
        markersize=5,
        color=style.VERMILION,
        markeredgecolor="white",
        capsize=3,
        lw=1.2,
        zorder=5,
        clip_on=False,
    )


def _add_legend(
    figure: Figure, metrics: dict[str, np.ndarray], evaluation: dict[str, Any] | None
) -> None:
    handles = [Line2D([], [], color=style.BLUE, lw=1.6)]
    labels = ["training, with exploration"]
    rows = evaluation_rows(metrics)
    if rows.any():
        switches = int((metrics["switched"][rows] > 0.5).sum())
        handles += [
            Line2D([], [], ls="none", marker="^", ms=6, color=style.GREEN),
            Line2D([], [], ls="none", marker="o", ms=4.5, mfc="white", mec=style.GREY),
        ]
        labels += [
            f"genetic evaluation, a child took over ({switches})",
            f"the agent stayed ({int(rows.sum()) - switches})",
        ]
    if evaluation is not None:
        marker = {"marker": "D", "ms": 6, "mec": "white"}
        handles.append(Line2D([], [], ls="none", color=style.VERMILION, **marker))
        rate, episodes = evaluation["success_rate"], evaluation["episodes"]
        labels.append(f"held out: {100.0 * rate:.1f} % of {episodes} episodes")
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=len(handles),
        frameon=False,
        fontsize=9.5,
    )
