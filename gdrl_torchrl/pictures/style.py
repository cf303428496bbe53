"""How the figures look: colours that colour-blind readers tell apart, quiet axes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from gdrl_torchrl.files.safe_files import own_folder, written_aside

# The palette of Okabe and Ito (2008).
BLUE = "#0072B2"
GREEN = "#009E73"
VERMILION = "#D55E00"
ORANGE = "#E69F00"
PURPLE = "#CC79A7"
INK = "#262626"
GREY = "#7f7f7f"

OUTCOME_COLOURS = {
    "success": GREEN,
    "timeout": VERMILION,
    "collision": PURPLE,
    "capsized": BLUE,
    "diverged": "#000000",
    "running": GREY,
}
OUTCOME_DASHES = {
    "success": "-",
    "timeout": (0, (5, 2)),
    "collision": (0, (1, 1)),
    "capsized": (0, (5, 1, 1, 1)),
    "diverged": (0, (1, 2)),
    "running": "-",
}

STILL_WATER = "#dbe8f1"
SEA_COLOURS = LinearSegmentedColormap.from_list("sea", ["#a9c6db", STILL_WATER, "#fbfdfe"])
"""Troughs to crests, pale enough for paths to be seen over them."""

FLOOR, OUTSIDE, OBSTACLE, WALL = "#fafaf8", "#e4e8ec", "#b4bbc3", "#565d66"
VEHICLE = "#f2c21a"
BEAM = "#d6272880"

Layout = Literal["constrained", "tight"] | None

_DPI = 150


def new_figure(width_in: float, height_in: float, *, layout: Layout = None) -> Figure:
    """Make a figure on a canvas of its own, in inches, at 150 dots per inch."""
    figure = Figure(
        figsize=(width_in, height_in), dpi=_DPI, layout=layout, facecolor="white"
    )
    FigureCanvasAgg(figure)
    return figure


def quiet(axes: Axes) -> None:
    """Take away what is not data: two spines, tick marks, dark grid lines."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#b0b0b0")
    axes.tick_params(length=3, color="#b0b0b0", labelsize=9, labelcolor=INK)
    axes.grid(color="#e4e4e4", linewidth=0.7)
    axes.set_axisbelow(True)


def save(figure: Figure, path: Path) -> Path:
    """Write a figure, making its folder; a reader never sees half a file."""
    own_folder(path.parent)
    with written_aside(path) as aside:
        figure.savefig(aside)
    return path
