"""Small parts that several tests of the tasks share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import gdrl_tasks

AXLE_AHEAD_OF_MIDDLE_M = 0.032
AWAY_M = 100.0
REST_HEIGHT_M = 0.0325
"""The axle's, the wheels pressed half a millimetre into the floor."""


@pytest.fixture
def indoor_at() -> Callable[..., gdrl_tasks.BatchSimulation]:
    """Makes worlds with robots at rest where a test wants them, in its own layouts."""

    def make(poses, *, layout=None, **options) -> gdrl_tasks.BatchSimulation:
        """One world for each pose (x, y of the body's middle and heading, ``[W, 3]``).

        ``layout(shapes, number)`` gives the places ``[N, 4]`` of world ``number``; None
        takes everything away, walls too. There is no goal near and no step limit.
        """
        poses = np.asarray(poses, dtype=float)
        count = len(poses)
        defaults = {"num_threads": 1, "step_limit": 10**6}
        worlds = gdrl_tasks.simulate(
            "indoor", num_worlds=count, seed=0, **defaults | options
        )
        worlds.reset(seeds=np.arange(count))
        state = worlds.get_state()
        places = state["arrays.obstacles"]
        if layout is None:
            places[..., :2] = AWAY_M
        else:
            shapes = worlds.task.arena.shapes
            places[...] = [layout(shapes, number) for number in range(count)]
        x, y, heading = poses.T
        qpos = state["qpos"]
        qpos[:] = 0.0
        qpos[:, 0] = x + AXLE_AHEAD_OF_MIDDLE_M * np.cos(heading)
        qpos[:, 1] = y + AXLE_AHEAD_OF_MIDDLE_M * np.sin(heading)
        qpos[:, 2] = REST_HEIGHT_M
        qpos[:, 3], qpos[:, 6] = np.cos(0.5 * heading), np.sin(0.5 * heading)
        state["arrays.goal"][:] = qpos[:, :2] + 50.0
        state["arrays.position"][:] = qpos[:, :2]
        state["arrays.distance"][:] = np.hypot(50.0, 50.0)
        worlds.set_state(state)
        return worlds

    return make


@pytest.fixture
def indoor_pose() -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Gives the body's middle ``[W, 2]`` and heading ``[W]`` of states ``[W, nq]``."""

    def pose(qpos):
        w, x, y, z = np.moveaxis(np.asarray(qpos, dtype=float)[..., 3:7], -1, 0)
        # The first column of the rotation matrix is where the robot looks.
        forward = np.stack([w * w + x * x - y * y - z * z, 2.0 * (w * z + x * y)], axis=-1)
        heading = np.arctan2(forward[..., 1], forward[..., 0])
        ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        return qpos[..., :2] - AXLE_AHEAD_OF_MIDDLE_M * ahead, heading

    return pose
