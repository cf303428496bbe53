"""What is drawn of the indoor task: the arena, the robot and its beams."""

from __future__ import annotations

import itertools
from typing import Any

import mujoco
import numpy as np
import pytest

from gdrl_tasks import make_task
from gdrl_tasks.indoor.definition import clearance
from gdrl_tasks.indoor.robot import LIDAR_HEIGHT_M
from tests.marks import full_but

ARENAS = ("paper", "scatter", "corridor", "trap")


@pytest.mark.render
@pytest.mark.parametrize("arena", full_but(["corridor"], ARENAS))
def test_top_camera_holds_the_arena_and_chase_camera_the_robot(arena: str) -> None:
    from gdrl_tasks.engines.dm_env import make_environment

    environment = make_environment(make_task("indoor", arena=arena))
    try:
        for seed in range(3):
            environment.task.next_episode_seed = seed
            environment.reset()
            top, chase = (_parts(environment.physics, name) for name in ("top", "chase"))
            walls = [top == f"obstacle_{number}" for number in range(4)]
            assert all(wall.any() for wall in walls)
            edge = np.ones_like(top, dtype=bool)
            edge[3:-3, 3:-3] = False
            assert set(top[edge]) <= {"floor"}
            assert {"goal_disc", "deck", "scan"} <= set(top.ravel())
            assert "scan" in chase
            row, column = np.argwhere(chase == "deck").mean(axis=0) / chase.shape
            assert 0.5 < row < 0.8
            assert column == pytest.approx(0.5, abs=0.02)
    finally:
        environment.close()


@pytest.mark.parametrize("report", ["exact", "held and noisy"])
def test_beams_end_on_what_they_hit_and_fade_out_where_they_hit_nothing(
    report: str,
) -> None:
    from gdrl_tasks.engines.dm_env import make_environment

    options: dict[str, Any] = {"num_beams": 72, "field_of_view_deg": 360.0}
    if report == "held and noisy":
        options |= {"scan_hold": True, "range_noise": True}
    task = make_task("indoor", arena="paper", **options)
    environment = make_environment(task)
    arrays, data = environment.task.arrays, environment.physics.data
    environment.task.next_episode_seed = 0
    environment.reset()
    held = 0
    for _ in range(8):
        before = arrays["scan"].copy()
        environment.step(4)
        held += np.array_equal(arrays["scan"], before)
    assert held >= (report == "held and noisy")

    task.draw_scenery(environment.physics, arrays)

    strips = _strips(environment.physics)
    shapes = task.arena.shapes
    for name in ("beams", "hits"):
        ends = strips[name][:, 1:3].mean(axis=1)
        assert len(ends) > 20
        places = np.repeat(arrays["obstacles"], len(ends), axis=0)
        distance = clearance(ends[:, :2], places, shapes.is_box, shapes.half_size)
        np.testing.assert_allclose(distance, 0.0, atol=1e-3)
    parts = [name for name in strips if name.startswith("fading")]
    # All beams are drawn that fit, and each once.
    assert len(strips["beams"]) + len(strips[parts[0]]) == 36
    middle, _ = task.body_centre(data.qpos[None])
    reach = [
        np.hypot(*(strips[name][:, 1:3].mean(axis=1)[:, :2] - middle).T) for name in parts
    ]
    np.testing.assert_allclose(reach[-1], 3.5, atol=1e-3)
    assert all((near < far).all() for near, far in itertools.pairwise(reach))
    opacity = [environment.physics.named.model.skin_rgba[name, "a"] for name in parts]
    assert opacity == sorted(opacity, reverse=True)
    assert opacity[-1] < 0.1
    for corners in strips.values():
        # The robot leans back by a thousandth as it drives.
        np.testing.assert_allclose(corners[..., 2], LIDAR_HEIGHT_M, atol=0.01)


def _strips(physics: Any) -> dict[str, np.ndarray]:
    """Corners of the drawn strips by skin, as a renderer gets them, ``[N, 4, 3]``."""
    model, data = physics.model.ptr, physics.data.ptr
    scene = mujoco.MjvScene(model, 1000)
    option, view = mujoco.MjvOption(), mujoco.MjvCamera()
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, option, None, view, everything, scene)
    vertices, strips = scene.skinvert.reshape(-1, 3), {}
    for skin in range(model.nskin):
        first, count = model.skin_vertadr[skin], model.skin_vertnum[skin]
        corners = vertices[first : first + count].reshape(-1, 4, 3)
        drawn = np.ptp(corners, axis=1).max(axis=-1) > 1e-6
        strips[mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SKIN, skin)] = corners[drawn]
    return strips


def _parts(physics: Any, camera: str) -> np.ndarray:
    """Names of the geoms that a camera sees, or ``scan``, ``[H, W]``."""
    number, kind = physics.render(240, 320, camera_id=camera, segmentation=True).transpose(
        2, 0, 1
    )
    count = physics.model.ngeom
    names = np.array([*(physics.model.id2name(i, "geom") for i in range(count)), ""])
    parts = names[np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, number, count)]
    return np.where(kind == mujoco.mjtObj.mjOBJ_SKIN, "scan", parts)
