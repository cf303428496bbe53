"""The figures of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from gdrl_torchrl.pictures import style
from gdrl_torchrl.reports.curves import band_of, drawn
from gdrl_torchrl.reports.drawing.svg import svg_of
from gdrl_torchrl.reports.evidence import Arm, Run
from gdrl_torchrl.reports.page.content import Panel
from gdrl_torchrl.reports.paper import PaperCurve, paper_method
from gdrl_torchrl.reports.statistics.averages import interquartile_mean
from gdrl_torchrl.reports.statistics.bootstrap import Estimate, estimate

COLOURS = (
    style.BLUE,
    style.VERMILION,
    style.GREEN,
    style.PURPLE,
    style.ORANGE,
    "#56B4E9",
    "#000000",
)
_DASHES: tuple[Any, ...] = ("-", (0, (1, 1)), (0, (5, 1, 1, 1)))
"""Once all colours are taken."""
MOST_BANDS = 6
"""Methods of a drawing up to which each has a band: more of them hide each other."""
Looks = Mapping[str, Mapping[str, Any]]
"""Colour and dashes by method, as matplotlib names them."""
COST_LABELS = {
    "agent_episodes": "episodes of the agent",
    "total_steps": "steps of agent and population",
    "wall_s": "wall time (s)",
}


def looks_of(methods: Sequence[str]) -> Looks:
    """A colour for each method, the same in all figures; dashes once they are used up."""
    size = len(COLOURS)
    return {
        name: {"color": COLOURS[k % size], "ls": _DASHES[k // size % len(_DASHES)]}
        for k, name in enumerate(methods)
    }


def _new_panel(height_in: float = 3.1) -> tuple[Figure, Axes]:
    # As wide as a phone: wider screens show several beside each other.
    figure = style.new_figure(4.6, height_in, layout="constrained")
    axes = figure.subplots()
    style.quiet(axes)
    return figure, axes


def _called(run: Run, method: str) -> str:
    state = "failed, counts as 0" if run.failed else f"score {run.score:.3f}"
    return f"{method}, seed {run.seed}: {state}; {run.origin}"


def scores_panel(name: str, arms: Sequence[Arm], looks: Looks, label: str) -> Panel:
    """Every run's score as a dot, and the interquartile mean with its interval.

    Args:
        name: Of the panel.
        arms: Methods on one task.
        looks: By method.
        label: What the scores are.
    """
    figure, axes = _new_panel(1.0 + 0.42 * len(arms))
    titles = {}
    for row, arm in enumerate(arms):
        colour = looks[arm.method]["color"]
        # Spread, so that equal scores are seen, the same way every time.
        at = row + 0.24 * np.linspace(-1.0, 1.0, len(arm.runs) + 2)[1:-1]
        for k, (run, y) in enumerate(zip(arm.runs, at, strict=True)):
            gid = f"run-{row}-{k}"
            titles[gid] = _called(run, arm.method)
            mark = "x" if run.failed else "o"
            axes.plot(run.score, y, mark, color=colour, ms=4.5, alpha=0.55, gid=gid)
        middle = estimate([arm.scores], interquartile_mean)
        axes.plot([middle.low, middle.high], [row, row], color=style.INK, lw=1.6)
        axes.plot(middle.value, row, "D", color=colour, mec=style.INK, ms=7)
    axes.set_yticks(range(len(arms)), [arm.method for arm in arms], parse_math=False)
    axes.set_ylim(len(arms) - 0.5, -0.5)
    axes.set_xlim(-0.02, 1.02)
    axes.set_xlabel(label, fontsize=9)
    alt = f"{label} of every run on {arms[0].task}, with interquartile means"
    return Panel(name, alt, svg_of(figure, name, alt, titles))


def differences_panel(
    name: str, differences: Mapping[str, Estimate], looks: Looks, label: str
) -> Panel:
    """Differences to a baseline, which is the line at zero, with their intervals.

    Args:
        name: Of the panel.
        differences: By method.
        looks: By method.
        label: What the differences are of.
    """
    figure, axes = _new_panel(1.0 + 0.3 * len(differences))
    axes.axvline(0.0, color=style.INK, lw=1.0)
    for row, (method, one) in enumerate(differences.items()):
        colour = looks[method]["color"]
        axes.plot([one.low, one.high], [row, row], color=colour, lw=2.0)
        axes.plot(one.value, row, "D", color=colour, mec=style.INK, ms=6)
    axes.set_yticks(range(len(differences)), list(differences), parse_math=False)
    axes.set_ylim(len(differences) - 0.5, -0.5)
    axes.set_xlabel(label, fontsize=9)
    return Panel(name, label, svg_of(figure, name, label, {}))


def curves_panel(
    name: str,
    arms: Sequence[Arm],
    cost: str,
    looks: Looks,
    label: str,
    paper: Sequence[PaperCurve] = (),
) -> Panel | None:
    """Success over a cost: every run a thin line, and bands of interquartile means.

    Args:
        name: Of the panel.
        arms: Methods on one task.
        cost: One of :data:`~gdrl_torchrl.reports.evidence.COSTS`.
        looks: By method.
        label: What the curves show.
        paper: Curves of the paper, drawn dashed behind ours.

    Returns:
        The panel; None if no run has a curve over this cost.
    """
    figure, axes = _new_panel(3.5)
    titles = {}
    of_paper = {paper_method(a.method): looks[a.method]["color"] for a in arms}
    for k, curve in enumerate(paper):
        # Each with dashes of its own: those of methods that we have not run are all grey.
        colour = of_paper.get(curve.method, style.GREY)
        dashes: Any = (0, (4, 1 + 1.5 * k))
        axes.plot(
            curve.agent_episodes,
            curve.success,
            color=colour,
            ls=dashes,
            lw=1.3,
            alpha=0.8,
            zorder=1,
            label=f"{curve.method}, paper",
        )
    for row, arm in enumerate(arms):
        for k, run in enumerate(arm.runs):
            x, y = drawn(run, cost)
            if not len(x):
                continue
            gid = f"run-{row}-{k}"
            titles[gid] = _called(run, arm.method)
            axes.plot(x, y, lw=0.7, alpha=0.4, gid=gid, **looks[arm.method])
        _draw_middle(axes, arm, cost, looks[arm.method], with_band=len(arms) <= MOST_BANDS)
    if not titles:
        return None
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlim(left=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel(COST_LABELS[cost], fontsize=9)
    axes.set_ylabel(label, fontsize=9)
    _add_legend(figure)
    alt = f"{label} on {arms[0].task} over {COST_LABELS[cost]}, every seed and the mean"
    return Panel(name, alt, svg_of(figure, name, alt, titles))


def _draw_middle(
    axes: Axes, arm: Arm, cost: str, look: Mapping[str, Any], *, with_band: bool
) -> None:
    band = band_of(arm.runs, cost)
    if band is None:
        return
    if with_band:
        colour = look["color"]
        axes.fill_between(band.x, band.low, band.high, color=colour, alpha=0.18, lw=0)
    axes.plot(band.x, band.middle, lw=2.2, zorder=3, label=arm.method, **look)


def _add_legend(figure: Figure) -> None:
    legend = figure.legend(
        loc="outside lower center", ncols=3, frameon=False, fontsize=8, handlelength=1.8
    )
    for text in legend.get_texts():
        # A dollar sign in a name does not begin a formula.
        text.set_parse_math(False)


def profiles_panel(
    name: str,
    profiles: Mapping[str, tuple[np.ndarray, ...]],
    looks: Looks,
    label: str,
) -> Panel:
    """Share of runs above every score, with bands.

    Args:
        name: Of the panel.
        profiles: Thresholds, shares, lower and upper limits, ``[T]`` each, by method.
        looks: By method.
        label: What the scores are.
    """
    figure, axes = _new_panel(3.3)
    for method, (thresholds, share, low, high) in profiles.items():
        if len(profiles) <= MOST_BANDS:
            colour = looks[method]["color"]
            axes.fill_between(thresholds, low, high, color=colour, alpha=0.18, lw=0)
        axes.plot(thresholds, share, lw=2.0, label=method, **looks[method])
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel(f"{label}, τ", fontsize=9)
    axes.set_ylabel("share of runs above τ", fontsize=9)
    _add_legend(figure)
    alt = f"Share of runs whose {label} is above a threshold, for every threshold"
    return Panel(name, alt, svg_of(figure, name, alt, {}))
