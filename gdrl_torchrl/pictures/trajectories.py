"""The figure of where the vehicles of a run went."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from matplotlib.ticker import MultipleLocator

from gdrl_torchrl.pictures import style
from gdrl_torchrl.pictures.layout import Layout, posed

_VIEW_MARGIN_M = 1.0
_WANDERER_REACH = 1.5
"""Paths farther out than this times the farthest goal do not widen the view."""
_MOST_PANELS = 8
_MOST_PATHS = 16
"""Of vessels in one picture: more are a tangle."""
_PANELS_WIDTH_IN = 12.0
"""Of all panels side by side, at most."""
_PANEL_LINE = 1.8
_HEADING_EVERY_M = 1.6
"""Way between two marks of where a vessel is heading, from half of that on."""
_HEADING_MARK = np.array([[0.2, 0.0], [-0.12, 0.11], [-0.05, 0.0], [-0.12, -0.11]])
"""Outline of such a mark, metres, ahead is +x."""
_START = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 7,
    "color": style.INK,
    "markeredgecolor": "white",
    "zorder": 5,
}


def make_trajectories(trajectories: dict[str, np.ndarray]) -> Figure:
    """Make the figure of :func:`gdrl_torchrl.pictures.figures.draw_trajectories`.

    Args:
        trajectories: Arrays of
            :func:`gdrl_torchrl.pictures.film.episodes.record_trajectories`.

    Returns:
        The paths of the first 16 episodes from above, x to the right and y up, in
        metres, coloured by outcome, with marks that show where a vessel is heading;
        where there are obstacles, which differ by episode, a panel for each of the
        first eight episodes.
    """
    if "obstacles" in trajectories:
        return _make_panels(trajectories)
    position = trajectories["position"]
    names = _outcomes(trajectories)
    shown = names[:_MOST_PATHS]
    figure = style.new_figure(8.4, 8.0, layout="constrained")
    axes = figure.add_subplot()
    _draw_sea(figure, axes, trajectories)
    for name in _in_order(shown):
        chosen = [k for k, other in enumerate(shown) if other == name]
        _draw_paths(axes, trajectories, chosen, name)
        _draw_headings(axes, trajectories, chosen, name)
    axes.plot(*position[0, : len(shown)].T, label="start", **_START)
    heading: dict[str, Any] = {"ls": "none", "marker": (3, 0, -90), "ms": 8}
    axes.plot([], [], label="heading", color=style.GREY, **heading)
    reach = view_reach(trajectories)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set_xlabel("x (m)", fontsize=10)
    axes.set_ylabel("y (m)", fontsize=10)
    axes.tick_params(length=3, color="#b0b0b0", labelsize=9)
    axes.spines[:].set_color("#b0b0b0")
    _add_legend(figure, trajectories, *axes.get_legend_handles_labels())
    title = _title(names, len(shown))
    if "sea_elevation" in trajectories:
        title += "\nThe sea is that of the first, at its start"
    figure.suptitle(title, fontsize=12, color=style.INK)
    return figure


def view_reach(trajectories: dict[str, np.ndarray], aspect: float = 1.0) -> float:
    """Half the height of a view of everything around the origin, metres.

    Where there is an arena, all of it is in the view. Elsewhere all goals are, and all
    paths but those of vehicles that wandered far off.

    Args:
        trajectories: Arrays of
            :func:`gdrl_torchrl.pictures.film.episodes.record_trajectories`.
        aspect: Width over height of the view.
    """
    layout = Layout.of(trajectories, 0)
    if layout is not None:
        length, width = layout.half_view_m
        return float(max(width, length / aspect))
    goals = np.abs(trajectories["goal"]).max() + float(trajectories["tolerance"])
    paths = np.nanmax(np.abs(trajectories["position"]))
    return float(min(max(goals, paths), _WANDERER_REACH * goals) + _VIEW_MARGIN_M)


def _make_panels(trajectories: dict[str, np.ndarray]) -> Figure:
    """One panel per episode, because each has other obstacles."""
    names = _outcomes(trajectories)
    shown = min(_MOST_PANELS, len(names))
    first = Layout.of(trajectories, 0)
    assert first is not None
    length, width = first.half_view_m
    # Panels of a long arena are wide: fewer fit side by side.
    columns_at_most = 4 if length < 1.5 * width else 2
    columns = min(columns_at_most, shown)
    rows = math.ceil(shown / columns)
    panel_in = _PANELS_WIDTH_IN / columns_at_most
    figure = style.new_figure(
        max(columns * panel_in, 0.6 * _PANELS_WIDTH_IN) + 0.6,
        rows * (panel_in * width / length + 0.25) + 1.2,
        layout="constrained",
    )
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for number, axes in enumerate(panels.flat):
        if number < shown:
            _draw_episode(axes, trajectories, number, names[number])
        else:
            axes.set_visible(False)
    panels[0, 0].set(xlim=(-length, length), ylim=(-width, width))
    for axes in panels[:, 0]:
        axes.set_ylabel("y (m)", fontsize=10)
    for column in range(columns):
        lowest = panels[(shown - 1 - column) // columns, column]
        lowest.set_xlabel("x (m)", fontsize=10)
        lowest.tick_params(labelbottom=True)
    order = _in_order(names[:shown])
    handles = [_path_sample(name) for name in order]
    labels = [f"{name} ({names[:shown].count(name)})" for name in order]
    handles.append(Line2D([], [], **_START))
    _add_legend(figure, trajectories, handles, [*labels, "start"])
    figure.suptitle(_title(names, shown), fontsize=12, color=style.INK)
    return figure


def _draw_episode(
    axes: Axes, trajectories: dict[str, np.ndarray], episode: int, name: str
) -> None:
    """Draw the path of an episode among its obstacles, and its end to scale."""
    layout = Layout.of(trajectories, episode)
    assert layout is not None
    layout.draw(axes)
    _draw_paths(axes, trajectories, [episode], name, width=_PANEL_LINE)
    start = _START | {"markersize": 5, "markeredgewidth": 0.6}
    axes.plot(*trajectories["position"][0, episode], **start)
    last = int(trajectories["steps"][episode])
    position = trajectories["position"][last, episode]
    heading = float(trajectories["heading"][last, episode])
    if np.isfinite(heading):
        corners = posed(layout.outline_m, position, heading)
        colour = style.OUTCOME_COLOURS[name]
        axes.add_patch(Polygon(corners, fc=colour, ec=style.INK, lw=0.7, zorder=4))
    axes.set_aspect("equal")
    axes.xaxis.set_major_locator(MultipleLocator(1.0))
    axes.yaxis.set_major_locator(MultipleLocator(1.0))
    axes.tick_params(length=2, color="#b0b0b0", labelsize=8)
    axes.spines[:].set_color("#b0b0b0")
    seconds = last * float(trajectories["control_interval_s"])
    title = f"{episode + 1}: {name} after {seconds:.1f} s"
    axes.set_title(title, fontsize=9, color=style.INK, pad=4)


def _draw_paths(
    axes: Axes,
    trajectories: dict[str, np.ndarray],
    chosen: list[int],
    name: str,
    *,
    width: float = 1.3,
) -> None:
    """Draw paths and goals of episodes with the same outcome."""
    position, steps = trajectories["position"], trajectories["steps"]
    colour = style.OUTCOME_COLOURS[name]
    axes.add_collection(
        LineCollection(
            [position[: steps[k] + 1, k] for k in chosen],
            colors=colour,
            linestyles=[style.OUTCOME_DASHES[name]],
            linewidths=width,
            alpha=0.85,
            label=f"{name} ({len(chosen)})",
            zorder=3,
        )
    )
    radius = float(trajectories["tolerance"])
    rings = [Circle(tuple(trajectories["goal"][k]), radius) for k in chosen]
    axes.add_collection(
        PatchCollection(
            rings, facecolor=(1, 1, 1, 0.55), edgecolor=colour, linewidths=1.2, zorder=2
        )
    )


def _draw_headings(
    axes: Axes, trajectories: dict[str, np.ndarray], chosen: list[int], name: str
) -> None:
    """Mark where vessels are heading, every so often along their paths."""
    marks = [
        posed(_HEADING_MARK, position, float(heading))
        for k in chosen
        for position, heading in _poses_along(trajectories, k)
    ]
    colour = style.OUTCOME_COLOURS[name]
    look: dict[str, Any] = {"facecolor": colour, "edgecolor": "white", "linewidths": 0.5}
    axes.add_collection(PolyCollection(marks, zorder=3.5, **look))


def _poses_along(
    trajectories: dict[str, np.ndarray], episode: int
) -> list[tuple[np.ndarray, float]]:
    """Positions and headings of an episode, equally far apart along its path."""
    last = int(trajectories["steps"][episode])
    position = trajectories["position"][: last + 1, episode]
    heading = trajectories["heading"][: last + 1, episode]
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(position, axis=0).T)))
    places = np.arange(0.5 * _HEADING_EVERY_M, way[-1], _HEADING_EVERY_M)
    steps = np.searchsorted(way, places).tolist()
    poses = [(position[step], float(heading[step])) for step in dict.fromkeys(steps)]
    return [pose for pose in poses if np.isfinite(pose[1])]


def _title(names: list[str], shown: int) -> str:
    """How many of the episodes with these outcomes are shown."""
    if shown == len(names):
        return f"{shown} episode{'s' * (shown > 1)} from above"
    counts = ", ".join(f"{names.count(name)} {name}" for name in _in_order(names))
    return f"The first {shown} of {len(names)} episodes from above (of all: {counts})"


def _outcomes(trajectories: dict[str, np.ndarray]) -> list[str]:
    return [str(trajectories["outcome_names"][i]) for i in trajectories["outcome"]]


def _in_order(names: list[str]) -> list[str]:
    """Different outcomes, always in the same order."""
    return sorted(set(names), key=list(style.OUTCOME_COLOURS).index)


def _path_sample(name: str) -> Line2D:
    look = {"color": style.OUTCOME_COLOURS[name], "ls": style.OUTCOME_DASHES[name]}
    return Line2D([], [], lw=_PANEL_LINE, **look)


def _add_legend(
    figure: Figure, trajectories: dict[str, np.ndarray], handles: list, labels: list[str]
) -> None:
    """Put a legend under the figure, the goal last."""
    tolerance = f"goal, within {float(trajectories['tolerance']):g} m"
    ring = Line2D([], [], ls="none", marker="o", ms=9, mfc="white", mec=style.GREY)
    figure.legend(
        [*handles, ring],
        [*labels, tolerance],
        loc="outside lower center",
        ncols=len(handles) + 1,
        frameon=False,
        fontsize=10,
    )


def _draw_sea(figure: Figure, axes: Axes, trajectories: dict[str, np.ndarray]) -> None:
    """Paint the wave field with its colour bar, or still water without one."""
    axes.set_facecolor(style.STILL_WATER)
    if "sea_elevation" not in trajectories:
        return
    elevation = trajectories["sea_elevation"]
    highest = float(np.abs(elevation).max())
    if highest == 0.0:
        return
    x, y = trajectories["sea_x"], trajectories["sea_y"]
    image = axes.imshow(
        elevation,
        origin="lower",
        extent=(x[0], x[-1], y[0], y[-1]),
        cmap=style.SEA_COLOURS,
        vmin=-highest,
        vmax=highest,
        interpolation="bilinear",
        zorder=1,
    )
    bar = figure.colorbar(image, ax=axes, shrink=0.55, pad=0.02, aspect=28)
    bar.set_label("elevation of the surface (m)", fontsize=10)
    bar.ax.tick_params(labelsize=9, length=3)
    bar.outline.set_edgecolor("#b0b0b0")
