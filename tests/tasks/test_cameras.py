"""The cameras of a task see what matters, and looking changes nothing."""

import itertools

import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks.water.definition import elevation
from tests.marks import full_but


@pytest.mark.render
@pytest.mark.parametrize("name", gdrl_tasks.task_names())
def test_both_cameras_draw_a_picture(name):
    environment = gdrl_tasks.load(name, random=0)
    environment.reset()
    frames = [environment.physics.render(120, 160, camera_id=c) for c in ("top", "chase")]
    for frame in frames:
        assert frame.shape == (120, 160, 3)
        assert frame.dtype == np.uint8
        assert frame.std() > 3.0
    assert (frames[0] != frames[1]).mean() > 0.2


@pytest.mark.render
@pytest.mark.parametrize("name", full_but(["water"], gdrl_tasks.task_names()))
def test_rendering_does_not_change_what_happens(name):
    seen, unseen = (gdrl_tasks.load(name, random=0) for _ in range(2))
    generator = np.random.default_rng(0)
    shape = seen.action_spec().shape
    seen.reset(), unseen.reset()
    for _ in range(10):
        action = 1 if shape == () else generator.uniform(-1.0, 1.0, size=shape)
        seen.physics.render(32, 32, camera_id="chase")
        seen.step(action), unseen.step(action)
        np.testing.assert_array_equal(seen.physics.get_state(), unseen.physics.get_state())


@pytest.mark.render
def test_waves_are_visible_and_move():
    def frames(sea):
        environment = gdrl_tasks.load("water", random=0, sea=sea)
        environment.reset()
        views = []
        for _ in range(2):
            views.append(environment.physics.render(240, 320, camera_id="top"))
            for _ in range(3):
                environment.step(np.zeros(2))
        return np.array(views, dtype=float)[:, :, :60]

    lake, calm = frames("lake"), frames("calm")
    assert calm.std(axis=(1, 2)).max() < 1.0
    assert lake.std(axis=(1, 2)).min() > 3.0
    assert np.abs(lake[1] - lake[0]).mean() > 3.0


@pytest.mark.render
@pytest.mark.parametrize("difficulty", ["near", "far"])
def test_the_top_camera_sees_the_whole_range_of_goals(difficulty):
    environment = gdrl_tasks.load("water", random=0, difficulty=difficulty)
    environment.reset()
    farthest = environment.task.task.options.goal_distance_m[1]
    for goal in ((0.0, farthest), (0.0, -farthest), (farthest, 0.0), (-farthest, 0.0)):
        environment.physics.data.mocap_pos[0, :2] = goal
        environment.task.arrays["goal"][0] = goal
        ids = environment.physics.render(240, 320, camera_id="top", segmentation=True)
        geom = environment.physics.model.name2id("goal_mark", "geom")
        assert (ids[..., 0] == geom).any()


ARENAS = ("paper", "scatter", "corridor", "trap")


@pytest.mark.render
@pytest.mark.parametrize("arena", full_but(["corridor"], ARENAS))
def test_the_top_camera_sees_the_whole_arena(arena):
    environment = gdrl_tasks.load("indoor", random=0, arena=arena)
    environment.reset()
    physics = environment.physics
    half_x, half_y = environment.task.task.arena.half_extent_m
    for x, y in itertools.product((-1.0, 1.0), (-1.0, 1.0)):
        physics.data.mocap_pos[0, :2] = x * (half_x - 0.2), y * (half_y - 0.2)
        physics.forward()
        ids = physics.render(240, 320, camera_id="top", segmentation=True)
        geom = physics.model.name2id("goal_disc", "geom")
        assert ((ids[..., 0] == geom) & (ids[..., 1] == 5)).any()
    walls = {physics.model.name2id(f"obstacle_{n}", "geom") for n in range(4)}
    assert walls <= set(ids[..., 0].ravel().tolist())


@pytest.mark.render
def test_the_drawn_surface_is_where_the_water_is():
    environment = gdrl_tasks.load(
        "water", random=0, significant_wave_height_m=0.4, peak_period_s=2.0
    )
    environment.reset()
    environment.step(np.zeros(2))
    environment.physics.render(16, 16, camera_id="top")
    model, data = environment.physics.model, environment.physics.data
    drawn = model.skin_vert.reshape(-1, 3)
    drawn = drawn[np.hypot(*(drawn[:, :2] - data.qpos[:2]).T) < 1.0]
    assert len(drawn) > 500
    sea = environment.task.arrays
    x, y = drawn[None, :, 0].astype(float), drawn[None, :, 1].astype(float)
    expected = elevation(sea, x, y, np.array([data.time]))[0]
    assert np.ptp(expected) > 0.05
    # Farther away the drawn surface is smoother, because its points are farther apart.
    np.testing.assert_allclose(drawn[:, 2], expected, atol=0.02)
