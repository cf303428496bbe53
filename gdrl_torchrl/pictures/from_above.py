"""Frames of an episode drawn from above: the video of a machine that cannot render."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle, Polygon
from matplotlib.patheffects import withStroke

from gdrl_torchrl.pictures import style
from gdrl_torchrl.pictures.layout import Layout, posed

Surface = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""Elevation in metres ``[M, N]`` over x ``[N]``, y ``[M]`` (metres) at a time (s)."""

# Outline of the boat in its own frame, metres, bow at +x.
_HALF_BOAT = np.array([[-0.65, 0.3], [-0.1, 0.38], [0.2, 0.34], [0.5, 0.18], [0.72, 0.0]])
_BOAT = np.concatenate([_HALF_BOAT, _HALF_BOAT[-2::-1] * [1.0, -1.0]])
_BOAT_BOW = np.array([[0.2, 0.34], [0.5, 0.18], [0.72, 0.0], [0.5, -0.18], [0.2, -0.34]])
_POINTER = np.array([[1.0, 0.0], [0.0, 0.5], [0.25, 0.0], [0.0, -0.5]])
_POINTER_SHARE, _POINTER_MARGIN = 0.14, 0.03
"""Length of what points at a goal out of view, and its distance from the edge, in parts of
half the panel's height."""
_CLOSE_HALF_HEIGHT_M = 2.0
_CLOSE_IN_ARENA_M = 1.2
_DOTS_PER_INCH = 100
_SEA_SAMPLES = 160
"""Samples of the surface across a panel; frames are drawn between them."""


class FromAbove:
    """Draws one episode, all of it at the left and close to the vehicle at the right.

    Args:
        goal: Position of the goal, metres, ``[2]``.
        tolerance_m: Radius of the goal.
        reach_m: Half the height of the left panel, around the origin.
        height: Height of a panel, pixels.
        width: Width of a panel, pixels.
        surface: Elevation of the sea, or None for still water.
        wave_height_m: Significant wave height, which sets the contrast of the sea.
        layout: Walls and obstacles, and the vehicle's outline; None for a boat on the
            sea.
        beam_angles: Directions of a lidar's beams from straight ahead, radians,
            ``[B]``; it is in the middle of the outline.
    """

    def __init__(
        self,
        *,
        goal: np.ndarray,
        tolerance_m: float,
        reach_m: float,
        height: int,
        width: int,
        surface: Surface | None = None,
        wave_height_m: float = 0.0,
        layout: Layout | None = None,
        beam_angles: np.ndarray | None = None,
    ) -> None:
        self.surface = surface
        self.layout = layout
        self.beam_angles = beam_angles
        inches = (2 * width / _DOTS_PER_INCH, height / _DOTS_PER_INCH)
        self.figure = Figure(figsize=inches, dpi=_DOTS_PER_INCH)
        self.canvas = FigureCanvasAgg(self.figure)
        close_m = _CLOSE_HALF_HEIGHT_M if layout is None else _CLOSE_IN_ARENA_M
        self.panels = [
            _Panel(
                self.figure.add_axes((left, 0.0, 0.5, 1.0)),
                half_height_m=half_height,
                aspect=width / height,
                contrast_m=max(wave_height_m, 1e-3),
                goal=goal,
                tolerance_m=tolerance_m,
                layout=layout,
            )
            for left, half_height in ((0.0, reach_m), (0.5, close_m))
        ]
        self.panels[1].axes.spines["left"].set(visible=True, color="white", linewidth=3.0)

    def draw(
        self,
        path: np.ndarray,
        heading: float,
        time_s: float,
        ranges: np.ndarray | None = None,
    ) -> np.ndarray:
        """Draw the vehicle at the end of its path so far.

        Args:
            path: Positions from the start to now, metres, ``[T, 2]``.
            heading: Heading now, radians.
            time_s: Time, seconds.
            ranges: What the lidar reports now, metres, ``[B]``.

        Returns:
            RGB image, uint8 ``[height, 2 width, 3]``.
        """
        beams = self._beams(path[-1], heading, ranges)
        for panel, centre in zip(self.panels, (np.zeros(2), path[-1]), strict=True):
            panel.place(centre, path, heading)
            panel.point_at_goal(centre)
            panel.paint_sea(self.surface, time_s)
            panel.beams.set_segments(beams)
        self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()

    def _beams(
        self, position: np.ndarray, heading: float, ranges: np.ndarray | None
    ) -> list[np.ndarray]:
        """Segments from the lidar to what it sees, ``[2, 2]`` each."""
        if self.layout is None or self.beam_angles is None or ranges is None:
            return []
        middle = self.layout.middle_m
        ahead = np.stack([np.cos(self.beam_angles), np.sin(self.beam_angles)], axis=-1)
        ends = posed(middle + ranges[:, None] * ahead, position, heading)
        start = posed(middle[None], position, heading)[0]
        return [np.stack([start, end]) for end in ends]


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
        layout: Layout | None,
    ) -> None:
        self.axes = axes
        self.goal = np.asarray(goal, dtype=float)
        self.half = np.array([aspect * half_height_m, half_height_m])
        axes.set(xticks=[], yticks=[], facecolor=style.STILL_WATER)
        axes.spines[:].set_visible(False)
        self.sea: AxesImage | None = None
        self.outline = _BOAT
        if layout is None:
            self.sea = axes.imshow(
                np.zeros((2, 2)),
                origin="lower",
                cmap=style.SEA_COLOURS,
                vmin=-contrast_m,
                vmax=contrast_m,
                interpolation="bilinear",
                aspect="auto",
            )
        else:
            layout.draw(axes)
            self.outline = layout.outline_m
        self.beams = LineCollection([], colors=style.BEAM, linewidths=0.8, zorder=1.4)
        axes.add_collection(self.beams, autolim=False)
        look = {"fc": (1, 1, 1, 0.3), "ec": style.VERMILION, "lw": 1.5}
        axes.add_patch(Circle((goal[0], goal[1]), tolerance_m, zorder=5, **look))
        # It is seen where the circle is a dot.
        axes.plot(*goal, marker="+", ms=12, mew=1.2, color=style.VERMILION, zorder=5)
        (self.path,) = axes.plot([], [], color=style.BLUE, lw=1.8, solid_capstyle="round")
        look = {"fc": style.VEHICLE, "ec": style.INK, "lw": 1.0}
        self.vehicle = Polygon(self.outline, closed=True, zorder=4, **look)
        axes.add_patch(self.vehicle)
        # A round robot does not show where it is heading, nor does a boat from afar.
        self._bow = _BOAT_BOW
        if layout is not None:
            front = np.array([self.outline[:, 0].max(), layout.middle_m[1]])
            self._bow = np.stack([layout.middle_m, front])
        look = {"fc": style.INK, "ec": style.INK, "lw": 1.6 if layout else 0.0}
        self.bow = Polygon(self._bow, closed=layout is None, zorder=4.5, **look)
        axes.add_patch(self.bow)
        look = {"fc": style.VERMILION, "ec": "white", "lw": 0.8}
        self.pointer = Polygon(_POINTER, closed=True, zorder=6, visible=False, **look)
        axes.add_patch(self.pointer)
        # Obstacles may lie under the scale.
        halo = [] if layout is None else [withStroke(linewidth=3.0, foreground="white")]
        self._add_scale(halo)

    def place(self, centre: np.ndarray, path: np.ndarray, heading: float) -> None:
        """Move the view and the vehicle in it."""
        low, high = centre - self.half, centre + self.half
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        self.path.set_data(*path.T)
        self.vehicle.set_xy(posed(self.outline, path[-1], heading))
        self.bow.set_xy(posed(self._bow, path[-1], heading))

    def point_at_goal(self, centre: np.ndarray) -> None:
        """Point at the goal from the edge of the view where it is out of it."""
        way = self.goal - centre
        edge = self.half - _POINTER_MARGIN * self.half[1]
        beyond = float(np.max(np.abs(way) / edge))
        self.pointer.set_visible(beyond > 1.0)
        if beyond > 1.0:
            length = _POINTER_SHARE * self.half[1]
            heading = float(np.arctan2(way[1], way[0]))
            tip = centre + way / beyond
            points = length * (_POINTER - _POINTER[0])
            self.pointer.set_xy(posed(points, tip, heading))

    def paint_sea(self, surface: Surface | None, time_s: float) -> None:
        """Paint the part of the sea that is in view."""
        if self.sea is None:
            return
        (left, right), (low, high) = self.axes.get_xlim(), self.axes.get_ylim()
        if surface is not None:
            rows = round(_SEA_SAMPLES * self.half[1] / self.half[0])
            x = _middles(left, right, _SEA_SAMPLES)
            y = _middles(low, high, rows)
            self.sea.set_data(surface(x, y, time_s))
        self.sea.set_extent((left, right, low, high))

    def _add_scale(self, effects: list[withStroke]) -> None:
        """A bar of a round length, in fractions of the panel, so that it stays put."""
        length_m = 1.0 if self.half[1] < 4.0 else 5.0
        share = length_m / (2.0 * self.half[0])
        self.axes.plot(
            [0.97 - share, 0.97],
            [0.05, 0.05],
            transform=self.axes.transAxes,
            color=style.INK,
            lw=2,
            path_effects=effects,
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
            path_effects=effects,
        )


def _middles(low: float, high: float, count: int) -> np.ndarray:
    """Middles of ``count`` equal cells between two ends."""
    return low + (np.arange(count) + 0.5) * (high - low) / count
