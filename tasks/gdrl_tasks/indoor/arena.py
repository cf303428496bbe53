"""Arenas: the places of obstacles, starts and goals.

Layout, start and goal are drawn again until a disc of the robot's footprint fits at
start and goal and a way leads from start to goal. So every episode can be solved.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import math
from typing import ClassVar

import numpy as np

from gdrl_tasks.indoor.free_space import FreeSpace, middles
from gdrl_tasks.indoor.obstacles import ABSENT_M, Shapes, make_shapes, place

WALL_HALF_M = 0.05
HEIGHT_M = 0.3
"""Height of walls and obstacles: taller than the lidar, which is at 0.18 m."""
_ATTEMPTS = 1000


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """One drawn episode of an arena."""

    places: np.ndarray
    """Places of the arena's shapes, ``[N, 4]``."""
    start: np.ndarray
    """Start of the footprint's centre, metres, ``[2]``."""
    heading_rad: float
    goal: np.ndarray
    """Goal, metres, ``[2]``."""
    shortest_path_m: float
    """Length of the shortest way from start to goal."""


class Arena(abc.ABC):
    """A walled rectangle around the origin, with the same shapes in every layout.

    Attributes:
        half_extent_m: Half the length and width inside the walls.
        shapes: Four walls, then the obstacles.
        start_clearance_m: Least distance of the start to any obstacle: room to turn
            round at full speed.
        goal_clearance_m: Least distance of the goal to any obstacle.
        goal_distance_m: Least distance of the goal to the start.
    """

    name: ClassVar[str]
    half_extent_m: ClassVar[tuple[float, float]]
    start_clearance_m: ClassVar[float] = 0.4
    goal_clearance_m: ClassVar[float] = 0.3
    goal_distance_m: ClassVar[float] = 0.5
    shapes: Shapes

    def __init__(self, boxes: list[tuple[float, float]], radii: list[float]) -> None:
        length, width = (half + 2.0 * WALL_HALF_M for half in self.half_extent_m)
        walls = [(WALL_HALF_M, width), (WALL_HALF_M, width)]
        walls += [(length, WALL_HALF_M), (length, WALL_HALF_M)]
        self.shapes = make_shapes([*walls, *boxes], radii, HEIGHT_M)
        x, y = (half + WALL_HALF_M for half in self.half_extent_m)
        self._walls = place(np.array([x, -x, 0.0, 0.0]), np.array([0.0, 0.0, y, -y]))

    def draw(
        self, generator: np.random.Generator, footprint_m: float, tolerance_m: float
    ) -> Scene:
        """Draw a layout, a start and a goal.

        Args:
            generator: Source of randomness.
            footprint_m: Radius of the robot's footprint.
            tolerance_m: Radius of the goal; the robot starts outside it.
        """
        for _ in range(_ATTEMPTS):
            places = np.concatenate([self._walls, self.draw_obstacles(generator)])
            space = FreeSpace.of(self.half_extent_m, self.shapes, places)
            may_start, may_end = self.cells_that_may_hold(places)
            start = self._draw_free(generator, space, self.start_clearance_m, may_start)
            goal = self._draw_free(generator, space, self.goal_clearance_m, may_end)
            if start is None or goal is None:
                continue
            straight = float(np.hypot(goal[0] - start[0], goal[1] - start[1]))
            if straight < self.goal_distance_m + tolerance_m:
                continue
            way = space.distance(start, goal, footprint_m)
            if math.isfinite(way):
                return Scene(
                    places=places,
                    start=start,
                    heading_rad=self.draw_heading(generator),
                    goal=goal,
                    shortest_path_m=max(way, straight),
                )
        raise RuntimeError(f"arena {self.name!r}: no layout in {_ATTEMPTS} had a way")

    def _draw_free(
        self,
        generator: np.random.Generator,
        space: FreeSpace,
        least_m: float,
        allowed: np.ndarray,
    ) -> np.ndarray | None:
        """A random point with room around it, in a free cell that may hold one."""
        # A point is at most half a cell's diagonal from the middle of its cell.
        fits = (space.clearance >= least_m + 0.0708) & allowed
        cells = np.flatnonzero(fits)
        if len(cells) == 0:
            return None
        row, column = divmod(int(cells[generator.integers(len(cells))]), len(space.x))
        middle = np.array([space.x[column], space.y[row]])
        return middle + generator.uniform(-0.05, 0.05, 2)

    def cells_that_may_hold(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Masks ``[R, C]`` of the cells for starts and for goals.

        They are the same in all layouts, unless an arena overrides this.

        Args:
            places: Places of the layout's shapes, ``[N, 4]``.
        """
        return self._same_in_all_layouts

    @functools.cached_property
    def _same_in_all_layouts(self) -> tuple[np.ndarray, np.ndarray]:
        x, y = self.cells
        start, goal = (self.may_hold(x, y, is_goal=kind) for kind in (False, True))
        return start, goal

    @functools.cached_property
    def cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Middles of the grid's cells: x and y, metres, ``[R, C]`` each."""
        x, y = np.meshgrid(*(middles(half) for half in self.half_extent_m))
        return x, y

    @abc.abstractmethod
    def draw_obstacles(self, generator: np.random.Generator) -> np.ndarray:
        """Places of the shapes beyond the walls, ``[N - 4, 4]``."""

    def may_hold(self, x: np.ndarray, y: np.ndarray, *, is_goal: bool) -> np.ndarray:
        """Mask of cells that may hold the goal or the start."""
        return np.ones(np.shape(x), dtype=bool)

    def draw_heading(self, generator: np.random.Generator) -> float:
        """Heading at the start, radians."""
        return float(generator.uniform(-math.pi, math.pi))


class PaperArena(Arena):
    """Four blocks around the start, with gaps at the corners, as in the papers' figure.

    Marchesini and Farinelli, "Discrete deep reinforcement learning for mapless
    navigation", ICRA 2020: two blocks of 2.2 x 0.5 m and two of 0.3 x 2.2 m, goals
    within 3.5 m on each axis; lengths were measured in the figure (15 %). Here each
    block is displaced by up to 0.15 m, so that no route can be learned by heart.
    """

    name = "paper"
    half_extent_m = (3.5, 3.5)

    _MIDDLES = np.array([[0.0, 1.4], [0.0, -1.4], [2.3, 0.0], [-2.3, 0.0]])
    _DISPLACEMENT_M = 0.15
    _START_M = 0.5

    def __init__(self) -> None:
        super().__init__([(1.1, 0.25), (1.1, 0.25), (0.15, 1.1), (0.15, 1.1)], [])

    def draw_obstacles(self, generator: np.random.Generator) -> np.ndarray:
        """The four blocks, each displaced a little."""
        reach = self._DISPLACEMENT_M
        x, y = (self._MIDDLES + generator.uniform(-reach, reach, (4, 2))).T
        return place(x, y)

    def may_hold(self, x: np.ndarray, y: np.ndarray, *, is_goal: bool) -> np.ndarray:
        """Starts are near the middle, goals anywhere."""
        return np.full(np.shape(x), is_goal) | (np.hypot(x, y) <= self._START_M)


class ScatterArena(Arena):
    """Cylinders and boxes anywhere, six to ten of them; starts and goals anywhere."""

    name = "scatter"
    half_extent_m = (3.5, 3.5)
    goal_distance_m = 1.0

    _FEWEST = 6

    def __init__(self) -> None:
        boxes = [(0.2, 0.2), (0.3, 0.15), (0.4, 0.1), (0.5, 0.2), (0.25, 0.25)]
        super().__init__(boxes, [0.1, 0.15, 0.2, 0.25, 0.3])

    def draw_obstacles(self, generator: np.random.Generator) -> np.ndarray:
        """Some of the shapes; the others are put out of sight."""
        count = len(self.shapes) - 4
        x, y = generator.uniform(-3.2, 3.2, (2, count))
        yaw = generator.uniform(-math.pi, math.pi, count)
        used = generator.permutation(count) < generator.integers(self._FEWEST, count + 1)
        return place(np.where(used, x, ABSENT_M), np.where(used, y, ABSENT_M), yaw)


class CorridorArena(Arena):
    """A corridor of 10.5 x 3.5 m with blocks at either side, from end to end.

    It has the size of the papers' test arena (ICRA 2020) and is for evaluation only.
    """

    name = "corridor"
    half_extent_m = (5.25, 1.75)
    goal_distance_m = 5.0

    def __init__(self) -> None:
        super().__init__([(0.2, 0.7), (0.2, 0.7), (0.2, 0.7)], [0.2, 0.2, 0.25, 0.25])

    def draw_obstacles(self, generator: np.random.Generator) -> np.ndarray:
        """Three blocks that leave a gap at one side each, four cylinders between."""
        x = np.array([-2.6, 0.0, 2.6]) + generator.uniform(-0.4, 0.4, 3)
        side = np.where(generator.integers(2, size=3) == 0, -1.0, 1.0)
        y = side * generator.uniform(0.9, 1.05, 3)
        between = np.array([-3.9, -1.3, 1.3, 3.9]) + generator.uniform(-0.3, 0.3, 4)
        across = generator.uniform(-1.2, 1.2, 4)
        return place(np.concatenate([x, between]), np.concatenate([y, across]))

    def may_hold(self, x: np.ndarray, y: np.ndarray, *, is_goal: bool) -> np.ndarray:
        """The start is at the left end, the goal at the right."""
        return x >= 4.2 if is_goal else x <= -4.2


class TrapArena(Arena):
    """A U of three walls: the start is in its mouth, the goal behind its bottom.

    Progress towards the goal, which the reward pays for, leads into the U. The ends of
    its sides are farther from the goal than the start is, so every way there gives up
    progress first. The U is turned and displaced in every layout, and with it go the
    places of start and goal.
    """

    name = "trap"
    half_extent_m = (3.5, 3.5)
    goal_distance_m = 1.0

    _WIDTH_M, _DEPTH_M, _HALF_WALL_M = 2.4, 1.2, 0.05
    _START, _GOAL = (-1.0, 0.2), (1.0, 0.3)
    """Along the U's axis from its bottom, and reach around there, metres."""
    _DISPLACEMENT_M = 0.7

    def __init__(self) -> None:
        thin = self._HALF_WALL_M
        side = (0.5 * self._DEPTH_M - thin, thin)
        super().__init__([(thin, 0.5 * self._WIDTH_M), side, side], [])

    def draw_obstacles(self, generator: np.random.Generator) -> np.ndarray:
        """Bottom and sides of the U, around a middle near that of the arena."""
        thin, reach = self._HALF_WALL_M, self._DISPLACEMENT_M
        yaw = generator.uniform(-math.pi, math.pi)
        middle = generator.uniform(-reach, reach, 2)
        # In the U's own frame, around its middle: x leads to the goal.
        along = np.array([0.5 * self._DEPTH_M - thin, -thin, -thin])
        across = np.array([0.0, 1.0, -1.0]) * (0.5 * self._WIDTH_M - thin)
        x = middle[0] + math.cos(yaw) * along - math.sin(yaw) * across
        y = middle[1] + math.sin(yaw) * along + math.cos(yaw) * across
        return place(x, y, yaw)

    def cells_that_may_hold(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Starts are in the mouth of the U, goals behind its bottom."""
        x, y, cosine, sine = places[4]
        start, goal = (
            np.hypot(self.cells[0] - x - along * cosine, self.cells[1] - y - along * sine)
            <= reach
            for along, reach in (self._START, self._GOAL)
        )
        return start, goal


ARENAS: dict[str, type[PaperArena | ScatterArena | CorridorArena | TrapArena]] = {
    arena.name: arena for arena in (PaperArena, ScatterArena, CorridorArena, TrapArena)
}
