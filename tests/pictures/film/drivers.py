"""Who drives the vehicles of the films."""

from __future__ import annotations

import numpy as np

from gdrl_tasks import NavigationTask
from gdrl_tasks.controllers import pursuit
from gdrl_torchrl.pictures.film import video

SEEDS = [11, 12]


def turn_to_goal(observation: np.ndarray) -> np.ndarray:
    """Turn rates of the indoor task that turn the robot to its goal, walls or not."""
    return np.clip(np.round(2.0 + 8.0 * observation[:, 1]), 0, 4).astype(np.int64)


CONTROLLERS = {"water": pursuit, "indoor": turn_to_goal}
DRIFTERS = {
    "water": lambda observation: np.zeros((len(observation), 2)),
    "indoor": lambda observation: np.full(len(observation), 2),
}


def drift(task: NavigationTask) -> video.Act:
    """What leaves a vehicle to itself."""
    return DRIFTERS[task.name]
