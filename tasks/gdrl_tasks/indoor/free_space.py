"""Where a robot can go in a layout: a grid of clearances and of distances to a goal."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np

from gdrl_tasks.indoor.kernel import clearances_on_grid
from gdrl_tasks.indoor.obstacles import Shapes
from gdrl_tasks.indoor.ways import fast_sweep, goal_in_sight, sure_looks

CELL_M = 0.1
"""Side of a grid cell."""
_SPARE_CELLS = 0.5
"""Least room around the disc in a free cell, in cells."""
_MOST_ROUNDS = 16
"""Rounds of four sweeps at most; a layout needs about three."""


@dataclasses.dataclass(frozen=True, eq=False)
class FreeSpace:
    """Clearances of a layout on a grid.

    Attributes:
        x: Columns, metres, ``[C]``.
        y: Rows, metres, ``[R]``.
        clearance: Distance of each cell's middle to the nearest obstacle, ``[R, C]``.
    """

    x: np.ndarray
    y: np.ndarray
    clearance: np.ndarray

    @classmethod
    def of(
        cls, half_extent_m: tuple[float, float], shapes: Shapes, places: np.ndarray
    ) -> FreeSpace:
        """The grid over an arena around the origin.

        Args:
            half_extent_m: Half the arena's length and width.
            shapes: The shapes.
            places: Their places, ``[N, 4]``.
        """
        x, y = (middles(half) for half in half_extent_m)
        clearance = clearances_on_grid(x, y, places, shapes.is_box, shapes.half_size)
        return cls(x, y, clearance)

    def distance(self, start: np.ndarray, goal: np.ndarray, footprint_m: float) -> float:
        """Length of :meth:`distances_to` for the cell that holds a start ``[2]`` only."""
        row, column = _cell(start[1], self.y), _cell(start[0], self.x)
        x, y = goal[0] - self.x[column], goal[1] - self.y[row]
        straight = math.hypot(x, y)
        looks = sure_looks(self._spare(footprint_m), _SPARE_CELLS, _SPARE_CELLS)
        # Nearly half of all goals are in sight, and then no sweep is needed.
        if looks[row, column] and goal_in_sight(looks, row, column, y / CELL_M, x / CELL_M):
            return straight
        speed = np.ones_like(self.clearance)
        # Nine ways in ten are not much longer than a straight line.
        for reach in (1.4 * straight + CELL_M, math.inf):
            way = float(self._sweep(looks, speed, goal, reach)[row, column])
            if way <= reach:
                break
        return way

    def distances_to(
        self, goal: np.ndarray, footprint_m: float, *, comfort_m: float = 0.0
    ) -> np.ndarray:
        """Lengths of the shortest ways of a disc's centre to a goal, metres, ``[R, C]``.

        The eikonal equation |grad T| = 1 / speed, T(goal) = 0, by fast sweeping (Zhao
        2005, https://doi.org/10.1090/S0025-5718-04-01678-3): like Dijkstra's algorithm,
        but ways are not bound to the grid. Where T is finite there is a way, because the
        disc always fits between the middles of neighbouring free cells: a free cell has
        half a cell of room around it.

        Args:
            goal: Position, metres, ``[2]``.
            footprint_m: Radius of the disc.
            comfort_m: Within this distance of an obstacle a step counts up to five times
                its length, so that ways keep away from obstacles; 0 gives true lengths.

        Returns:
            Distances; infinite where the disc does not fit or from where no way leads.
        """
        spare, comfort = self._spare(footprint_m), comfort_m / CELL_M
        speed = np.ones_like(spare)
        if comfort > 0.0:
            speed = np.clip(spare / comfort, 0.2, 1.0)
        looks = sure_looks(spare, _SPARE_CELLS, max(_SPARE_CELLS, comfort))
        return self._sweep(looks, speed, goal, math.inf)

    def _spare(self, footprint_m: float) -> np.ndarray:
        """Room around a disc in the middle of each cell, in cells, ``[R, C]``."""
        return (self.clearance - footprint_m) / CELL_M

    def _sweep(
        self, looks: np.ndarray, speed: np.ndarray, goal: np.ndarray, reach_m: float
    ) -> np.ndarray:
        away = goal[0] - self.x, goal[1] - self.y
        return fast_sweep(looks, speed, *away, CELL_M, _MOST_ROUNDS, reach_m)

    def cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the cells that hold points ``[..., 2]``, each ``[...]``."""
        column = np.rint((points[..., 0] - self.x[0]) / CELL_M).astype(np.int64)
        row = np.rint((points[..., 1] - self.y[0]) / CELL_M).astype(np.int64)
        return np.clip(row, 0, len(self.y) - 1), np.clip(column, 0, len(self.x) - 1)


def _cell(place_m: float, middles_m: np.ndarray) -> int:
    """The same as :meth:`FreeSpace.cells`, along one axis and for one place."""
    cell = round((place_m - middles_m[0]) / CELL_M)
    return min(max(cell, 0), len(middles_m) - 1)


@functools.cache
def middles(half_m: float) -> np.ndarray:
    """Middles of the cells from ``-half_m`` to ``half_m``, metres."""
    count = round(2.0 * half_m / CELL_M)
    return (np.arange(count) - 0.5 * (count - 1)) * CELL_M
