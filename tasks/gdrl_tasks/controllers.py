"""Hand-written controllers: they pin how hard a task is, and show how to solve it."""

from __future__ import annotations

import math

import numpy as np

_TURN_PER_RADIAN = 2.5
_AHEAD = 0.4
_AHEAD_WIDTH_RAD = 0.4
_DEAD_ZONE = 0.4


def pursuit(observation: np.ndarray) -> np.ndarray:
    """Steer the vessel of the water task towards its goal.

    It turns in proportion to the goal's bearing, goes ahead the more the goal lies
    ahead, and steps over the thrusters' dead zone.

    Args:
        observation: Flat observations that begin with the goal's distance and its
            bearing over pi, ``[W, D]``.

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
    return np.sign(thrust) * (_DEAD_ZONE + (1.0 - _DEAD_ZONE) * np.abs(thrust))
