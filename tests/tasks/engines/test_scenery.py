"""What only the eye sees makes no difference to what happens."""

from __future__ import annotations

import itertools
import math
from typing import Any

import mujoco
import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import make_task, task_names
from gdrl_tasks.engines import batch
from gdrl_tasks.engines.batch import BatchSimulation
from gdrl_tasks.engines.scenery import cast_fewer_shadows, without_scenery
from gdrl_tasks.water.scenery import _place_chase_camera
from gdrl_tasks.water.wake import Track, foam
from tests.marks import full_but

BOX = '<geom size="0.1" contype="{touches}" conaffinity="0" mass="{mass}"/>'
MODEL = """
<mujoco><worldbody><light/><camera/>
  <body name="box"><freejoint/>
    <geom name="solid" size="0.1" mass="1"/>
    {geom}
  </body>
  <body name="mark" mocap="true"><geom size="0.2" contype="0" conaffinity="0"/></body>
  <body name="door" mocap="true"><geom size="0.2"/></body>
  <body><freejoint/><geom size="0.3"/></body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize("name", task_names())
def test_states_and_rewards_are_those_of_the_whole_model(name, monkeypatch):
    task = make_task(name)
    ours = BatchSimulation(task, 6, num_threads=1, seed=0)
    monkeypatch.setattr(batch, "without_scenery", mujoco.MjModel.from_xml_string)
    whole = BatchSimulation(task, 6, num_threads=1, seed=0)
    worlds = [ours, whole]
    generator = np.random.default_rng(0)
    assert np.array_equal(*(w.reset(seeds=np.arange(6)) for w in worlds))
    for _ in range(60):
        shape = (6,) if task.spec.is_discrete else (6, task.spec.action_size)
        action = generator.uniform(-1.0, 1.0, size=shape)
        if task.spec.is_discrete:
            action = generator.integers(task.spec.action_size, size=shape)
        alive = np.flatnonzero(ours.arrays["outcome"] == 0)
        if len(alive) == 0:
            break
        for one, other in zip(*(w.step(action[alive], alive) for w in worlds), strict=True):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(ours.qpos, whole.qpos)
        np.testing.assert_array_equal(ours.qvel, whole.qvel)
    assert ours.model.ngeom < whole.model.ngeom


@pytest.mark.parametrize("name", [n for n in task_names() if make_task(n).model_fields])
def test_walls_have_the_same_numbers_in_both_models(name):
    # One and the same task writes their places into either.
    task = make_task(name)
    engine, whole = without_scenery(task.xml()), mujoco.MjModel.from_xml_string(task.xml())
    names = [[m.geom(i).name for i in range(m.ngeom)] for m in (engine, whole)]
    walls = [[(i, n) for i, n in enumerate(x) if "obstacle" in n] for x in names]
    assert walls[0] == walls[1]
    assert walls[0]


def test_only_what_touches_and_weighs_nothing_is_left_out():
    model = without_scenery(MODEL.format(geom=BOX.format(touches=0, mass=0)))
    assert [model.geom(i).name for i in range(model.ngeom)] == ["solid", "", ""]
    assert [model.body(i).name for i in range(model.nbody)] == ["world", "box", "door", ""]
    assert (model.ncam, model.nlight) == (0, 0)
    model = without_scenery(MODEL.format(geom=BOX.format(touches=1, mass=1)))
    assert model.ngeom == 4
    with pytest.raises(ValueError, match="mass of 'box'"):
        without_scenery(MODEL.format(geom=BOX.format(touches=0, mass=1)))


@pytest.mark.parametrize("name", task_names())
def test_the_vehicle_is_what_the_task_takes_for_it(name):
    # Forces of the water act on the last body; joints of other things would come first.
    model = mujoco.MjModel.from_xml_string(make_task(name).xml())
    joint = model.joint(0)
    assert joint.type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert model.body(joint.bodyid[0]).name == {"water": "hull"}.get(name, "robot")
    if name == "water":
        assert joint.bodyid[0] == model.nbody - 1


def _drive(name: str, action: Any, steps: int, **options: Any) -> Any:
    environment = gdrl_tasks.load(name, random=0, **options)
    environment.task.next_episode_seed = 3
    environment.reset()
    for _ in range(steps):
        environment.step(action)
    return environment


def _free_view(
    physics: Any, *, height_m: float, azimuth_deg: float, pitch_deg: float = 0.0
) -> np.ndarray:
    """What a camera 9 m beside the vessel sees of the sea."""
    from dm_control.mujoco import engine

    physics.render(16, 16, camera_id="top")
    camera = engine.MovableCamera(
        physics,
        240,
        320,
        scene_callback=lambda _, scene: cast_fewer_shadows(scene.ptr),
    )
    x, y = physics.data.qpos[:2]
    camera.set_pose([x + 8.0, y + 4.0, height_m], 0.01, azimuth_deg, pitch_deg)
    picture = camera.render()
    return picture.astype(float)


@pytest.mark.render
@pytest.mark.parametrize(
    ("height_m", "azimuth_deg"),
    [
        (1.0, 0.0),
        pytest.param(1.0, 60.0, marks=pytest.mark.full),
        pytest.param(2.0, 120.0, marks=pytest.mark.full),
        (5.0, 300.0),
    ],
)
def test_the_sea_goes_to_the_horizon_without_an_edge(height_m, azimuth_deg):
    environment = _drive("water", np.zeros(2), 2)
    picture = _free_view(environment.physics, height_m=height_m, azimuth_deg=azimuth_deg)
    # The horizon is in the middle row.
    profile = picture.mean(axis=1)
    step = np.abs(np.diff(profile, axis=0)).max(axis=1)
    assert np.abs(profile[10] - profile[-10]).max() > 60.0
    # Nor is there a stripe that is lighter than both sky and sea.
    assert profile[118:122].max() <= profile[:120].max() + 3.0
    assert step[80:200].max() < 22.0


@pytest.mark.render
def test_the_chase_camera_sees_no_edge_of_the_sea():
    environment = _drive("water", np.ones(2), 3)
    picture = environment.physics.render(360, 480, camera_id="chase").astype(float)
    profile = np.concatenate([picture[:, :60], picture[:, -60:]], axis=1).mean(axis=1)
    step = np.abs(np.diff(profile, axis=0)).max(axis=1)
    assert step.max() < 22.0
    assert np.abs(profile[0] - profile[-1]).max() > 60.0


def _water_beside_the_vessel(environment: Any) -> tuple[np.ndarray, np.ndarray]:
    """Strips of a picture from above: behind the stern and ahead of the bow."""
    physics = environment.physics
    size = 480
    picture = physics.render(size, size, camera_id="top").astype(float)
    camera = physics.model.name2id("top", "camera")
    half = math.tan(math.radians(0.5 * physics.model.cam_fovy[camera]))
    scale = 0.5 * size / (half * physics.data.cam_xpos[camera, 2])
    w, z = physics.data.qpos[3], physics.data.qpos[6]
    ahead = np.array([w * w - z * z, 2.0 * w * z])
    across = np.array([-ahead[1], ahead[0]])
    along, aside = np.meshgrid(np.linspace(0.9, 2.0, 30), np.linspace(-0.5, 0.5, 30))
    strips = []
    for sign in (-1.0, 1.0):
        place = (
            physics.data.qpos[:2]
            + sign * along[..., None] * ahead
            + aside[..., None] * across
        )
        column = (0.5 * size + scale * place[..., 0]).astype(int)
        row = (0.5 * size - scale * place[..., 1]).astype(int)
        strips.append(picture[row, column])
    return strips[0], strips[1]


@pytest.mark.render
def test_foam_is_behind_a_vessel_under_way_and_not_ahead():
    environment = _drive("water", np.ones(2), 10, sea="calm")
    behind, ahead = _water_beside_the_vessel(environment)
    water = np.median(ahead.reshape(-1, 3), axis=0)
    assert np.abs(ahead - water).max() < 8.0
    white = (behind - water).min(axis=-1) > 25.0
    assert white.mean() > 0.15

    environment.task.next_episode_seed = 3
    environment.reset()
    for strip in _water_beside_the_vessel(environment):
        assert np.abs(strip - np.median(strip, axis=(0, 1))).max() < 8.0


@pytest.mark.render
def test_a_picture_does_not_depend_on_those_rendered_before():
    often, once = (gdrl_tasks.load("water", random=0, sea="rough") for _ in "ab")
    for environment in (often, once):
        environment.task.next_episode_seed = 3
        environment.reset()
    for _ in range(8):
        often.physics.render(16, 16, camera_id="top")
        for environment in (often, once):
            environment.step(np.ones(2))
    pictures = [e.physics.render(120, 160, camera_id="chase") for e in (often, once)]
    np.testing.assert_array_equal(*pictures)


@pytest.mark.render
def test_bow_and_stern_look_different():
    environment = _drive("water", np.zeros(2), 0, sea="calm")
    physics = environment.physics
    from dm_control.mujoco import engine

    # The goal's mark is red, too.
    physics.data.mocap_pos[0, :2] = environment.task.arrays["goal"][0] = 500.0
    w, z = physics.data.qpos[3], physics.data.qpos[6]
    heading = math.degrees(2.0 * math.atan2(z, w))
    physics.render(16, 16, camera_id="top")
    camera = engine.MovableCamera(physics, 240, 320)
    red = []
    for azimuth in (heading, heading + 180.0):
        camera.set_pose([*physics.data.qpos[:2], 0.1], 3.0, azimuth, -20.0)
        picture = camera.render().astype(int)
        yellow = (picture[..., 0] > 150) & (picture[..., 1] > 110) & (picture[..., 2] < 80)
        assert yellow.mean() > 0.005
        red.append(((picture[..., 0] > 120) & (picture[..., 1:].max(axis=-1) < 80)).mean())
    stern, bow = red
    assert stern > 0.003
    assert stern > 2.0 * bow


@pytest.mark.render
@pytest.mark.parametrize("camera", full_but(["chase"], ["top", "chase"]))
@pytest.mark.parametrize("name", task_names())
def test_things_cast_shadows(name, camera):
    environment = gdrl_tasks.load(name, random=0)
    environment.task.next_episode_seed = 3
    environment.reset()
    physics = environment.physics
    assert physics.model.light_castshadow.any()
    shaded = physics.render(240, 320, camera_id=camera).astype(int)
    physics.model.light_castshadow[:] = False
    lit = physics.render(240, 320, camera_id=camera).astype(int)
    darker = ((lit - shaded).min(axis=-1) > 15).mean()
    # A vessel seen from 17 m above is small, and half of its shadow is under it.
    least = {("water", "top"): 1e-4, ("water", "chase"): 1.5e-3}.get((name, camera), 3e-3)
    assert least < darker < 0.3
    # And light is where there is none.
    assert ((shaded - lit).max(axis=-1) > 15).mean() < 0.002


@pytest.mark.render
@pytest.mark.parametrize("name", full_but(["water"], task_names()))
def test_pictures_of_any_size_up_to_3840_by_2160_are_rendered(name):
    environment = gdrl_tasks.load(name, random=0)
    environment.reset()
    small = environment.physics.render(60, 80, camera_id="chase")
    wide = environment.physics.render(60, 3840, camera_id="chase")
    assert wide.shape == (60, 3840, 3)
    assert wide[:, -1].std() > 5.0
    high = environment.physics.render(2160, 60, camera_id="chase")
    assert high.shape == (2160, 60, 3)
    again = environment.physics.render(60, 80, camera_id="chase")
    assert np.abs(again.astype(int) - small).max() <= 3
    with pytest.raises(ValueError, match="3841"):
        environment.physics.render(60, 3841, camera_id="chase")


@pytest.mark.render
@pytest.mark.parametrize(
    ("bearing_deg", "distance_m"),
    [
        pytest.param(0.0, 3.0, marks=pytest.mark.full),
        pytest.param(50.0, 5.0, marks=pytest.mark.full),
        (-80.0, 3.0),
        (120.0, 5.0),
    ],
)
def test_the_chase_camera_sees_vessel_and_goal(bearing_deg, distance_m):
    environment = _drive("water", np.zeros(2), 1)
    physics = environment.physics
    heading = 2.0 * math.atan2(physics.data.qpos[6], physics.data.qpos[3])
    angle = heading + math.radians(bearing_deg)
    goal = physics.data.qpos[:2] + distance_m * np.array([math.cos(angle), math.sin(angle)])
    physics.data.mocap_pos[0, :2] = goal
    environment.task.arrays["goal"][0] = goal
    number, kind = physics.render(240, 320, camera_id="chase", segmentation=True).transpose(
        2, 0, 1
    )
    for name in ("goal_mark", "deck"):
        geom = physics.model.name2id(name, "geom")
        assert ((number == geom) & (kind == mujoco.mjtObj.mjOBJ_GEOM)).any()


@pytest.mark.parametrize(
    "jump",
    [(3.25, 9.0, 0.0), (0.0, 0.0, 0.0), (9.0, 3.5, 0.0)],
    ids=["elsewhere", "back in time", "after a gap"],
)
def test_a_vessel_that_was_put_somewhere_else_has_no_wake_yet(jump):
    x, y = np.linspace(-3.0, 12.0, 150), np.linspace(-3.0, 3.0, 60)
    track = Track()
    for step in range(13):
        track.note(0.25 * step, 0.25 * step, 0.0, 0.0)
    rows, columns, cover = foam(track, x, y)
    covered = x[columns][(cover > 0.1).any(axis=0)]
    # The stern is 0.6 m behind the middle, which is at 3 m.
    assert covered.min() < 0.5
    assert covered.max() < 3.0 - 0.6 + 0.2
    assert np.abs(y[rows][(cover > 0.1).any(axis=1)]).max() < 1.5

    track.note(*jump, 0.0)

    assert foam(track, x, y) is None


def test_the_chase_camera_has_the_goal_in_view_wherever_it_is():
    environment = gdrl_tasks.load("water", random=0)
    environment.reset()
    model, data = environment.physics.model, environment.physics.data
    camera = model.name2id("chase", "camera")
    half_height = np.tan(0.5 * np.radians(model.cam_fovy[camera]))
    bearings = np.radians(np.arange(-180.0, 180.0, 15.0))
    distances_m = (0.3, 0.7, 1.0, 1.4, 1.8, 2.2, 3.0, 8.0)
    for bearing, distance_m in itertools.product(bearings, distances_m):
        away = distance_m * np.array([np.cos(bearing), np.sin(bearing)])
        data.qpos[:7] = [2.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        _place_chase_camera(model, data, data.qpos[:2] + away)
        goal = np.append(data.qpos[:2] + away, 0.0)
        right, up, back = data.cam_xmat[camera].reshape(3, 3).T @ (
            goal - data.cam_xpos[camera]
        )
        assert back < 0.0
        # Of a picture whose width is 4/3 of its height.
        assert abs(right / back) < 4.0 / 3.0 * half_height, np.degrees(bearing)
        assert abs(up / back) < half_height, np.degrees(bearing)


@pytest.mark.render
def test_from_above_the_bow_is_told_from_the_stern():
    environment = gdrl_tasks.load("water", random=0)
    environment.reset()
    physics = environment.physics
    physics.data.qpos[:7] = [0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0]
    environment.task.arrays["goal"][:] = [[4.0, 4.0]]
    picture = physics.render(720, 960, camera_id="top").astype(int)
    near = picture[330:390, 430:530]
    white = np.argwhere(near.min(axis=2) > 170)
    yellow = np.argwhere((near[..., 0] > 140) & (near[..., 2] < 90))
    # Ahead is to the right, where there is white between the bows; none is astern.
    stern, bow = yellow[:, 1].min(), yellow[:, 1].max()
    places = (np.unique(white[:, 1]) - stern) / (bow - stern)
    assert (places > 0.72).sum() >= 10
    assert not (places < 0.1).any()
