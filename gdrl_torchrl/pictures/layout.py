"""Walls and obstacles of a recorded episode, and the vehicle among them, from above."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Patch, Polygon

from gdrl_torchrl.pictures import style

_CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
_ABSENT_M = 50.0
"""Shapes this far out are those that the episode does not use."""
_MARGIN_M = 0.3
"""Of floor around the arena: it shows the walls, which are outside of it."""


@dataclasses.dataclass(frozen=True, eq=False)
class Layout:
    """What stands in the arena of one episode.

    Attributes:
        half_extent_m: Half the length and width inside the walls, ``[2]``.
        places: x, y (metres), cosine and sine of the yaw of the shapes, ``[N, 4]``.
        is_box: Mask of boxes, ``[N]``; the others are round.
        half_size_m: Half length and half width, ``[N, 2]``; of the round ones the
            radius, twice.
        outline_m: Corners of the vehicle in its own frame, ahead is +x, ``[P, 2]``.
    """

    half_extent_m: np.ndarray
    places: np.ndarray
    is_box: np.ndarray
    half_size_m: np.ndarray
    outline_m: np.ndarray

    @classmethod
    def of(cls, trajectories: dict[str, np.ndarray], episode: int) -> Layout | None:
        """The layout of an episode; None if nothing stands in its way.

        Args:
            trajectories: Arrays of
                :func:`gdrl_torchrl.pictures.film.episodes.record_trajectories`.
            episode: Number of the episode, from 0.
        """
        if "obstacles" not in trajectories:
            return None
        places = trajectories["obstacles"][episode]
        used = np.abs(places[:, :2]).max(axis=1) < _ABSENT_M
        return cls(
            half_extent_m=trajectories["half_extent"],
            places=places[used],
            is_box=trajectories["obstacle_is_box"][used],
            half_size_m=trajectories["obstacle_half_size"][used],
            outline_m=trajectories["vehicle_outline"],
        )

    @property
    def half_view_m(self) -> np.ndarray:
        """Half the sides of a view of the arena with its walls, ``[2]``."""
        return self.half_extent_m + _MARGIN_M

    @property
    def middle_m(self) -> np.ndarray:
        """Middle of the outline in the vehicle's frame, ``[2]``."""
        return 0.5 * (self.outline_m.min(axis=0) + self.outline_m.max(axis=0))

    def draw(self, axes: Axes) -> None:
        """Add floor, walls and obstacles to axes in metres."""
        axes.set_facecolor(style.OUTSIDE)
        for patch in self._patches():
            axes.add_patch(patch)

    def _patches(self) -> Iterator[Patch]:
        floor = self.half_extent_m * _CORNERS
        yield Polygon(floor, closed=True, facecolor=style.FLOOR, linewidth=0.0, zorder=0.5)
        for place, is_box, half in zip(
            self.places, self.is_box, self.half_size_m, strict=True
        ):
            # What has its middle outside of the arena is its wall.
            is_wall = (np.abs(place[:2]) > self.half_extent_m).any()
            look = {
                "facecolor": style.WALL if is_wall else style.OBSTACLE,
                "edgecolor": style.WALL,
                "linewidth": 0.0 if is_wall else 0.6,
                "zorder": 1.5 if is_wall else 1.2,
            }
            if is_box:
                yaw = math.atan2(place[3], place[2])
                yield Polygon(posed(half * _CORNERS, place[:2], yaw), closed=True, **look)
            else:
                yield Circle((place[0], place[1]), half[0], **look)


def posed(points: np.ndarray, position: np.ndarray, heading: float) -> np.ndarray:
    """Points ``[P, 2]`` of a vehicle's frame in the world's, metres.

    Examples:
        >>> posed(np.array([[1.0, 0.0]]), np.array([3.0, 0.0]), 0.5 * np.pi).round(6)
        array([[3., 1.]])
    """
    cosine, sine = math.cos(heading), math.sin(heading)
    return position + points @ np.array([[cosine, sine], [-sine, cosine]])
