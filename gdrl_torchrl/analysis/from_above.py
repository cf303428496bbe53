"""Frames of an episode drawn from above: the video of a machine that cannot render."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle, Polygon

from gdrl_torchrl.analysis import style

Surface = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""Elevation in metres ``[M, N]`` over x ``[N]``, y ``[M]`` (metres) at a time (s)."""

# Outline of the vehicle in its own frame, metres, bow at +x.
_HALF_OUTLINE = np.array([[-0.65, 0.38], [0.2, 0.38], [0.5, 0.22], [0.68, 0.0]])
_OUTLINE = np.concatenate([_HALF_OUTLINE, _HALF_OUTLINE[-2::-1] * [1.0, -1.0]])
_CLOSE_HALF_HEIGHT_M = 2.0
_DOTS_PER_INCH = 100
_SEA_SAMPLES = 160
"""Samples of the surface across a panel; frames are drawn between them."""


class FromAbove:
    """Draws one episode, all of it at the left and close to the boat at the right.

    Args:
        goal: Position of the goal, metres, ``[2]``.
        tolerance_m: Radius of the goal.
        reach_m: Half the height of the left panel, around the origin.
        wave_height_m: Significant wave height, which sets the contrast of the sea.
        surface: Elevation of the sea, or None for still water.
        height: Height of a panel, pixels.
        width: Width of a panel, pixels.
    """

    def __init__(
        self,
        *,
        goal: np.ndarray,
        tolerance_m: float,
        reach_m: float,
        wave_height_m: float,
        surface: Surface | None,
        height: int,
        width: int,
    ) -> None:
        self.surface = surface
        inches = (2 * width / _DOTS_PER_INCH, height / _DOTS_PER_INCH)
        self.figure = Figure(figsize=inches, dpi=_DOTS_PER_INCH)
        self.canvas = FigureCanvasAgg(self.figure)
        aspect = width / height
        self.panels = [
            _Panel(
                self.figure.add_axes((left, 0.0, 0.5, 1.0)),
                half_height_m=half_height,
                aspect=aspect,
                contrast_m=max(wave_height_m, 1e-3),
                goal=goal,
                tolerance_m=tolerance_m,
            )
            for left, half_height in ((0.0, reach_m), (0.5, _CLOSE_HALF_HEIGHT_M))
        ]
        self.panels[1].axes.spines["left"].set(visible=True, color="white", linewidth=3.0)

    def draw(self, path: np.ndarray, heading: float, time_s: float) -> np.ndarray:
        """Draw the boat at the end of its path so far.

        Args:
            path: Positions from the start to now, metres, ``[T, 2]``.
            heading: Heading now, radians.
            time_s: Time, seconds.

        Returns:
            RGB image, uint8 ``[height, 2 width, 3]``.
        """
        overview, close = self.panels
        overview.place(np.zeros(2), path, heading, self.surface, time_s)
        close.place(path[-1], path, heading, self.surface, time_s)
        self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()


class _Panel:
    """One view with the artists that move in it."""

    def __init__(
        self,
        axes: Axes,
        *,
        half_height_m: float,
        aspect: float,
        contrast_m: float,
        goal: np.ndarray,
        tolerance_m: float,
    ) -> None:
        self.axes = axes
        self.half = np.array([aspect * half_height_m, half_height_m])
        axes.set(xticks=[], yticks=[], facecolor=style.STILL_WATER)
        axes.spines[:].set_visible(False)
        self.sea: AxesImage = axes.imshow(
            np.zeros((2, 2)),
            origin="lower",
            cmap=style.SEA_COLOURS,
            vmin=-contrast_m,
            vmax=contrast_m,
            interpolation="bilinear",
            aspect="auto",
        )
        look = {"fc": (1, 1, 1, 0.3), "ec": style.VERMILION, "lw": 1.5}
        axes.add_patch(Circle((goal[0], goal[1]), tolerance_m, zorder=5, **look))
        # It is seen where the circle is a dot.
        axes.plot(*goal, marker="+", ms=12, mew=1.2, color=style.VERMILION, zorder=5)
        (self.path,) = axes.plot([], [], color=style.BLUE, lw=1.8, solid_capstyle="round")
        look = {"fc": "#f2c21a", "ec": style.INK, "lw": 1.0}
        self.boat = Polygon(_OUTLINE, closed=True, zorder=4, **look)
        axes.add_patch(self.boat)
        self._add_scale()

    def place(
        self,
        centre: np.ndarray,
        path: np.ndarray,
        heading: float,
        surface: Surface | None,
        time_s: float,
    ) -> None:
        """Move the view and everything in it."""
        low, high = centre - self.half, centre + self.half
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        if surface is not None:
            rows = round(_SEA_SAMPLES * self.half[1] / self.half[0])
            x = _middles(low[0], high[0], _SEA_SAMPLES)
            y = _middles(low[1], high[1], rows)
            self.sea.set_data(surface(x, y, time_s))
        self.sea.set_extent((low[0], high[0], low[1], high[1]))
        self.path.set_data(*path.T)
        cosine, sine = np.cos(heading), np.sin(heading)
        turn = np.array([[cosine, sine], [-sine, cosine]])
        self.boat.set_xy(path[-1] + _OUTLINE @ turn)

    def _add_scale(self) -> None:
        """A bar of a round length, in fractions of the panel, so that it stays put."""
        length_m = 1.0 if self.half[1] < 4.0 else 5.0
        share = length_m / (2.0 * self.half[0])
        self.axes.plot(
            [0.97 - share, 0.97],
            [0.05, 0.05],
            transform=self.axes.transAxes,
            color=style.INK,
            lw=2,
        )
        self.axes.text(
            0.97 - 0.5 * share,
            0.065,
            f"{length_m:g} m",
            transform=self.axes.transAxes,
            ha="center",
            va="bottom",
            fontsize=9,
            color=style.INK,
        )


def _middles(low: float, high: float, count: int) -> np.ndarray:
    """Middles of ``count`` equal cells between two ends."""
    return low + (np.arange(count) + 0.5) * (high - low) / count
