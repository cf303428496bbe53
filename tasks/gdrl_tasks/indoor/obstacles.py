"""Obstacles of a layout as arrays.

A layout is ``N`` upright shapes, boxes and cylinders, walls among them. Their sizes
belong to the arena and never change; their places are an array ``[W, N, 4]`` of x, y
(metres) and the cosine and sine of the yaw.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

ABSENT_M = 100.0
"""Place of shapes that a layout does not use, far out of sight."""


@dataclasses.dataclass(frozen=True, eq=False)
class Shapes:
    """The shapes that an arena's layouts are made of."""

    is_box: np.ndarray
    """Mask of boxes, ``[N]``; the others are cylinders."""
    half_size: np.ndarray
    """Half length and half width, metres, ``[N, 2]``; a cylinder's radius, twice."""
    height_m: float

    def __len__(self) -> int:
        return len(self.is_box)


def make_shapes(
    boxes: list[tuple[float, float]], radii: list[float], height_m: float
) -> Shapes:
    """Shapes from half sizes of boxes and radii of cylinders, in that order.

    Examples:
        >>> len(make_shapes([(1.0, 0.1)], [0.2, 0.3], height_m=0.3))
        3
    """
    half_size = [*boxes, *((radius, radius) for radius in radii)]
    is_box = np.arange(len(half_size)) < len(boxes)
    return Shapes(is_box, np.array(half_size, dtype=float).reshape(-1, 2), height_m)


def place(x: Any, y: Any, yaw: Any = 0.0) -> np.ndarray:
    """Places of shapes, ``[..., 4]``, from x, y (metres) and yaw (radians).

    Examples:
        >>> place(1.0, 2.0).tolist()
        [1.0, 2.0, 1.0, 0.0]
    """
    places = np.empty((*np.broadcast(x, y, yaw).shape, 4))
    places[..., 0], places[..., 1] = x, y
    places[..., 2], places[..., 3] = np.cos(yaw), np.sin(yaw)
    return places
