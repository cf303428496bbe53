"""Hand-written controllers: they measure how hard a task is and show how to solve it."""

from __future__ import annotations

import math

import numpy as np

from gdrl_tasks.indoor.free_space import FreeSpace
from gdrl_tasks.indoor.robot import FOOTPRINT_M
from gdrl_tasks.indoor.task import IndoorTask
from gdrl_tasks.spec import WorldArrays
from gdrl_tasks.water.task import WaterTask

_TURN_PER_RADIAN = 2.5
_AHEAD = 0.4
_AHEAD_WIDTH_RAD = 0.4
_DEAD_ZONE = 0.4
_COMFORT_M = 0.25
_LOOK_AHEAD_M = 0.2
_DIRECTIONS = 64
_SPEED_M_S = 1.0
"""Through the water, of a vessel in :func:`pursuit`: 18 N of thrust against the drag."""
_LARGEST_CRAB_RAD = 1.25


def pursuit(observation: np.ndarray, *, dead_zone: float = _DEAD_ZONE) -> np.ndarray:
    """Steer the vessel of the water task towards its goal.

    It turns in proportion to the goal's bearing, goes ahead faster the more the goal lies
    ahead, and compensates the thrusters' dead zone.

    Args:
        observation: Flat observations that begin with the goal's distance and its
            bearing over pi, ``[W, D]``.
        dead_zone: Command up to which a thruster does nothing: that of the default hull,
            or 0 where the task's ``dead_zone_compensated`` is on.

    Returns:
        Port and starboard commands in [-1, 1], ``[W, 2]``.

    Examples:
        >>> pursuit(np.array([[1.0, 0.0, 0.0], [1.0, 0.5, 0.0]])).round(2)
        array([[ 0.64,  0.64],
               [-1.  ,  1.  ]])
    """
    bearing = math.pi * observation[:, 1]
    turn = _TURN_PER_RADIAN * bearing
    ahead = _AHEAD * np.exp(-((bearing / _AHEAD_WIDTH_RAD) ** 2))
    thrust = np.clip(np.stack([ahead - turn, ahead + turn], axis=-1), -1.0, 1.0)
    return np.sign(thrust) * (dead_zone + (1.0 - dead_zone) * np.abs(thrust))


def pursue_goal(observation: np.ndarray) -> np.ndarray:
    """Turn the robot of the indoor task towards its goal, without regard to obstacles.

    Args:
        observation: Flat observations, ``[W, D]``.

    Returns:
        Choices among the five turn rates from right to left, ``[W]``.

    Examples:
        >>> pursue_goal(np.array([[1.0, 0.0], [1.0, 0.5], [1.0, -0.04]])).tolist()
        [2, 4, 1]
    """
    bearing = math.pi * observation[:, 1]
    # Angles turned in half a step of 0.12 s at 45 and at 67.5 degrees/s.
    limits = np.radians([-8.1, -2.7, 2.7, 8.1])
    return np.digitize(bearing, limits)


class Pilot:
    """Steers the vessel of the water task to its goal on a straight course over ground.

    Unlike a policy it knows the current. It heads off the goal's bearing by the angle at
    which the current's part across the course is made good, and else steers as
    :func:`pursuit` does.

    Args:
        task: The task, with continuous actions.
        arrays: The arrays of its worlds at the start of their episodes.
    """

    def __init__(self, task: WaterTask, arrays: WorldArrays) -> None:
        self.task = task
        self._goal, self._current = arrays["goal"].copy(), arrays["current"].copy()
        compensated = task.options.dead_zone_compensated
        self._dead_zone = 0.0 if compensated else task.hull.dead_zone

    def __call__(self, worlds: np.ndarray, qpos: np.ndarray) -> np.ndarray:
        """Port and starboard commands ``[K, 2]`` for worlds ``[K]`` at positions."""
        position, yaw = self.task.planar_pose(qpos)
        x, y = (self._goal[worlds] - position).T
        course = np.arctan2(y, x)
        along, across = self._current[worlds].T
        drift = np.cos(course) * across - np.sin(course) * along
        most = math.sin(_LARGEST_CRAB_RAD)
        crab = np.arcsin(np.clip(drift / _SPEED_M_S, -most, most))
        bearing = _within_half_a_turn(course - crab - yaw)
        goal = np.stack([np.hypot(x, y), bearing / math.pi], axis=-1)
        return pursuit(goal, dead_zone=self._dead_zone)


class Planner:
    """Drives the robot of the indoor task along the shortest way away from walls.

    Unlike a policy it knows the layout. It shows that the task can be solved.

    Args:
        task: The task, with discrete actions.
        arrays: The arrays of its worlds at the start of their episodes.
    """

    def __init__(self, task: IndoorTask, arrays: WorldArrays) -> None:
        self.task = task
        arena = task.arena
        spaces = [
            FreeSpace.of(arena.half_extent_m, arena.shapes, places)
            for places in arrays["obstacles"]
        ]
        self._space = spaces[0]
        self._ways = np.stack(
            [
                space.distances_to(goal, FOOTPRINT_M, comfort_m=_COMFORT_M)
                for space, goal in zip(spaces, arrays["goal"], strict=True)
            ]
        )

    def __call__(self, worlds: np.ndarray, qpos: np.ndarray) -> np.ndarray:
        """Choices among the five turn rates ``[K]`` for worlds ``[K]`` at positions."""
        centre, yaw = self.task.body_centre(qpos)
        angles = np.linspace(-math.pi, math.pi, _DIRECTIONS, endpoint=False)
        reach = _LOOK_AHEAD_M * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        row, column = self._space.cells(centre[:, None] + reach)
        way = self._ways[worlds[:, None], row, column]
        bearing = _within_half_a_turn(angles[way.argmin(axis=1)] - yaw)
        return pursue_goal(np.stack([bearing, bearing / math.pi], axis=-1))


def _within_half_a_turn(angle: np.ndarray) -> np.ndarray:
    """The same angles in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
