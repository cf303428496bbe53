"""The figure of how a run learned."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter

from gdrl_torchrl.pictures import style

_TIMES = ((10_800.0, 3600.0, "h"), (120.0, 60.0, "min"), (0.0, 1.0, "s"))
"""From so many seconds on, a unit's seconds and its name."""
_SWITCHED: dict[str, Any] = {"ls": "none", "marker": "^", "ms": 6, "color": style.GREEN}
_KEPT: dict[str, Any] = {
    "ls": "none",
    "marker": "o",
    "ms": 4.5,
    "mfc": "white",
    "mec": style.GREY,
}
_FEW_POINTS = 3
"""Of a curve, which are marked: a line of one point is not seen."""
COLUMNS = ("agent_steps", "total_steps", "wall_s", "success_rate", "mut_p", "switched")
"""What must be there of a run's metrics; ``fitness_best`` and ``fitness_mean`` may be."""


@dataclasses.dataclass(frozen=True)
class _Cost:
    """What success is drawn over."""

    column: str
    label: str
    unit: float = 1.0
    width: float = 1.0


@dataclasses.dataclass(frozen=True)
class _Words:
    """What the legend calls the success rate, and an evaluation by what it led to."""

    success: str
    switched: str
    kept: str


_GENETIC = _Words(
    "training, with exploration",
    "genetic evaluation, a child took over",
    "the agent stayed",
)
_LIVING = _Words(
    "training, with exploration",
    "evaluation, the agent's copy among the elites",
    "not among them",
)
_ALONE = _Words(
    "the elite, when it was chosen", "generation with a new elite", "the elite stayed"
)


def make_learning_curve(
    metrics: dict[str, np.ndarray], evaluation: dict[str, Any] | None = None
) -> Figure:
    """Make the figure of success rate over all that it cost.

    Args:
        metrics: Columns ``[R]`` of :func:`~gdrl_torchrl.files.metrics.read_metrics`.
        evaluation: Held-out evaluation, if there was one.

    Returns:
        One column of panels per cost that there was: success rate and, if populations
        were evaluated, below it their mutation probability or, where there is none,
        their fitness.
    """
    below = _below(metrics)
    num_rows = 1 if below is None else 2
    costs = _costs(metrics)
    figure = style.new_figure(11.0, 3.2 + 1.4 * num_rows, layout="constrained")
    panels = figure.subplots(
        num_rows,
        len(costs),
        sharex="col",
        sharey="row",
        squeeze=False,
        width_ratios=[cost.width for cost in costs],
        height_ratios=[3.0, 1.0][:num_rows],
    )
    for column, cost in enumerate(costs):
        top, lowest = panels[0, column], panels[-1, column]
        x = metrics[cost.column] / cost.unit
        known = np.isfinite(metrics["success_rate"])
        mark = "o" if known.sum() <= _FEW_POINTS else None
        look = {"color": style.BLUE, "lw": 1.6, "marker": mark, "ms": 4}
        top.plot(x[known], metrics["success_rate"][known], **look)
        if below is not None:
            _mark_switches(top, x, metrics)
            below(lowest, x, metrics)
        if evaluation is not None:
            _draw_held_out(top, evaluation[cost.column] / cost.unit, evaluation)
        for axes in panels[:, column]:
            style.quiet(axes)
        lowest.set_xlabel(cost.label, fontsize=10)
        is_count = cost.column != "wall_s"
        most = 6 if column == 0 else 4
        lowest.xaxis.set_major_locator(MaxNLocator(most, integer=is_count))
        lowest.set_xlim(left=0.0)
        if is_count:
            lowest.xaxis.set_major_formatter(EngFormatter(sep=""))
    panels[0, 0].set_ylim(-0.02, 1.05)
    panels[0, 0].yaxis.set_major_formatter(PercentFormatter(1.0))
    panels[0, 0].set_ylabel("success rate", fontsize=10)
    if below is _draw_mutation:
        panels[1, 0].set_ylim(0.0, 1.0)
        panels[1, 0].set_ylabel("mutation\nprobability", fontsize=10)
    elif below is _draw_fitness:
        panels[1, 0].set_ylabel("fitness: best\nand mean", fontsize=10)
    _add_legend(figure, metrics, evaluation)
    if evaluation is not None:
        title = "{algorithm} on {task}, seed {seed}".format_map(evaluation)
        # A dollar sign in a name does not begin a formula.
        figure.suptitle(title, fontsize=12, color=style.INK, parse_math=False)
    return figure


def evaluation_rows(metrics: dict[str, np.ndarray]) -> np.ndarray:
    """Mask of the rows of training that ended with a genetic evaluation, ``[R]``."""
    return _is_known(metrics, "switched")


def _is_known(metrics: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Mask of the rows in which there is a value, ``[R]``."""
    nothing = np.full(len(metrics["total_steps"]), np.nan)
    return np.isfinite(metrics.get(name, nothing))


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


def _costs(metrics: dict[str, np.ndarray]) -> list[_Cost]:
    """All costs but steps of an agent where there is none; time in a fitting unit."""
    longest = metrics["wall_s"].max(initial=0.0)
    unit, name = next((unit, name) for least, unit, name in _TIMES if longest >= least)
    costs = [
        _Cost("total_steps", "environment steps, agent and population", width=2.0),
        _Cost("agent_steps", "steps of the agent"),
        _Cost("wall_s", f"wall time ({name})", unit),
    ]
    if _is_without_agent(metrics):
        costs[:2] = [_Cost("total_steps", "environment steps of the population", width=2.0)]
    return costs


def _is_without_agent(metrics: dict[str, np.ndarray]) -> bool:
    rows = evaluation_rows(metrics)
    return bool(rows.any()) and not (metrics["agent_steps"] > 0).any()


def _below(metrics: dict[str, np.ndarray]) -> Callable[..., None] | None:
    """What draws the lower panels, if anything is known that belongs there."""
    rows = evaluation_rows(metrics)
    if (rows & _is_known(metrics, "mut_p")).any():
        return _draw_mutation
    if (rows & _is_known(metrics, "fitness_best")).any():
        return _draw_fitness
    return None


def _words(metrics: dict[str, np.ndarray]) -> _Words:
    if _is_without_agent(metrics):
        return _ALONE
    return _GENETIC if _below(metrics) is not _draw_fitness else _LIVING


def _mark_switches(axes: Axes, x: np.ndarray, metrics: dict[str, np.ndarray]) -> None:
    rows = evaluation_rows(metrics)
    for at in x[rows & (metrics["switched"] > 0.5)]:
        axes.axvline(at, color=style.GREEN, lw=0.8, alpha=0.35, zorder=1)


def _draw_fitness(bottom: Axes, x: np.ndarray, metrics: dict[str, np.ndarray]) -> None:
    """Draw best and mean fitness of populations, and mark evaluations on the best."""
    rows = evaluation_rows(metrics)
    best = metrics["fitness_best"]
    bottom.plot(x[rows], best[rows], color="#b0b0b0", lw=1.2)
    if "fitness_mean" in metrics:
        mean = metrics["fitness_mean"]
        bottom.plot(x[rows], mean[rows], color="#b0b0b0", lw=1.2, ls=(0, (4, 2)))
    _mark_evaluations(bottom, x, best, metrics)


def _draw_mutation(bottom: Axes, x: np.ndarray, metrics: dict[str, np.ndarray]) -> None:
    """Draw steps of the mutation probability, and mark evaluations on them."""
    rows = evaluation_rows(metrics)
    probability = metrics["mut_p"]
    # The probability holds until the next evaluation finds another one.
    edges, values = np.append(x[rows], x[-1]), probability[rows]
    bottom.step(edges, np.append(values, values[-1]), where="post", color="#b0b0b0", lw=1.2)
    _mark_evaluations(bottom, x, probability, metrics)


def _mark_evaluations(
    axes: Axes, x: np.ndarray, y: np.ndarray, metrics: dict[str, np.ndarray]
) -> None:
    """Mark evaluations by what they led to."""
    rows = evaluation_rows(metrics)
    switched = rows & (metrics["switched"] > 0.5)
    kept = rows & ~switched
    axes.plot(x[kept], y[kept], **_KEPT)
    axes.plot(x[switched], y[switched], **_SWITCHED)


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
    words = _words(metrics)
    handles = [Line2D([], [], color=style.BLUE, lw=1.6)]
    labels = [words.success]
    if _below(metrics) is not None:
        rows = evaluation_rows(metrics)
        switches = int((metrics["switched"][rows] > 0.5).sum())
        handles += [Line2D([], [], **_SWITCHED), Line2D([], [], **_KEPT)]
        labels += [
            f"{words.switched} ({switches})",
            f"{words.kept} ({int(rows.sum()) - switches})",
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
