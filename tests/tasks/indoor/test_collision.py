"""Whoever touches a wall or an obstacle has collided, and nobody gets through."""

import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import Outcome
from tests.marks import full_but

FOOTPRINT_M = 0.11
MARGIN_M = 0.005
STRAIGHT = 2
AWAY = [100.0, 100.0, 1.0, 0.0]
every_arena = pytest.mark.parametrize("arena", ["paper", "scatter", "corridor", "trap"])


def gap_to_shape(middle, is_box, half_size, at):
    """Gaps between footprints around ``middle`` ``[P, 2]`` and a shape that is apart."""
    offset = middle - at[..., :2]
    if not is_box:
        return np.linalg.norm(offset, axis=-1) - half_size[0] - FOOTPRINT_M
    cosine, sine = at[..., 2], at[..., 3]
    own_x = cosine * offset[..., 0] + sine * offset[..., 1]
    own_y = cosine * offset[..., 1] - sine * offset[..., 0]
    own = np.stack([own_x, own_y], axis=-1)
    return np.linalg.norm(own - own.clip(-half_size, half_size), axis=-1) - FOOTPRINT_M


def gaps(middle, places, shapes):
    """Gaps between footprints ``[W, 2]`` and what is nearest in ``[W, N, 4]``, ``[W]``."""
    each = [
        gap_to_shape(middle, is_box, half_size, places[:, number])
        for number, (is_box, half_size) in enumerate(
            zip(shapes.is_box, shapes.half_size, strict=True)
        )
    ]
    return np.min(each, axis=0)


def only(number, at):
    """A layout with one shape of the arena; ``at`` is a place or one for each world."""

    def layout(shapes, world):
        places = np.tile(AWAY, (len(shapes), 1))
        places[number] = at if np.ndim(at) == 1 else at[world]
        return places

    return layout


# Of the scatter arena: the wall to the right, five blocks, five cylinders.
SHAPES = {"wall": 0, "block": 5, "long block": 7, "thin cylinder": 9, "cylinder": 13}
every_shape = pytest.mark.parametrize("shape", list(SHAPES))


def approaches(shape, count, indoor_at, **options):
    """Robots that drive at an obstacle at the origin, from head-on to just past it.

    Returns the worlds and how near each would come on a straight line.
    """
    generator = np.random.default_rng(len(shape))
    task = gdrl_tasks.make_task("indoor", arena="scatter")
    is_box = task.arena.shapes.is_box[SHAPES[shape]]
    half_size = task.arena.shapes.half_size[SHAPES[shape]]
    yaw = generator.uniform(-np.pi, np.pi, count)
    at = np.stack([np.zeros(count), np.zeros(count), np.cos(yaw), np.sin(yaw)], axis=-1)
    bearing = generator.uniform(-np.pi, np.pi, count)
    if shape == "wall":
        # From somewhere beside it, at any angle: 0.3 m from its face, or more.
        along = generator.uniform(-2.0, 2.0, count)
        bearing = yaw + generator.uniform(-1.3, 1.3, count)
        beside = 0.5 * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
        beside += along[:, None] * np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    else:
        outwards = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
        aside = np.stack([-outwards[:, 1], outwards[:, 0]], axis=-1)
        widest = np.hypot(*half_size) if is_box else half_size[0]
        shift = generator.uniform(-1.0, 1.0, (count, 1)) * (widest + FOOTPRINT_M + 0.04)
        beside = (widest + 0.3) * outwards + shift * aside
    heading = bearing + np.pi
    poses = np.concatenate([beside, heading[:, None]], axis=1)
    layout = only(SHAPES[shape], at)
    worlds = indoor_at(poses, layout=layout, arena="scatter", **options)
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    line = beside + np.linspace(0.0, 2.0, 2001)[:, None, None] * ahead
    near = [gap_to_shape(points, is_box, half_size, at) for points in line]
    return worlds, np.min(near, axis=0)


@every_shape
@pytest.mark.parametrize("speed", full_but([0.20], [0.10, 0.15, 0.20]))
def test_who_drives_at_an_obstacle_collides(shape, speed, indoor_at, indoor_pose):
    count = 48
    options = {"speed_m_s": speed, "at_limit": "truncated", "goal_tolerance_m": 0.05}
    worlds, nearest = approaches(shape, count, indoor_at, **options)
    shapes, places = worlds.task.arena.shapes, worlds.arrays["obstacles"]
    running = np.arange(count)
    for _ in range(round(2.0 / (0.12 * speed))):
        before, _ = indoor_pose(worlds.qpos[running])
        result = worlds.step(np.full(len(running), STRAIGHT), running)
        after, _ = indoor_pose(worlds.qpos[running])
        room = gaps(after, places[running], shapes)
        hit = result.outcome == Outcome.COLLISION
        np.testing.assert_array_equal(hit, room <= MARGIN_M)
        assert (gaps(before, places[running], shapes) > MARGIN_M).all()
        assert (result.outcome[~hit] == Outcome.RUNNING).all()
        assert (result.reward[hit] == -1.0).all()
        np.testing.assert_array_equal(result.terminated, hit)
        assert not result.truncated.any()
        running = running[~hit]
        if len(running) == 0:
            break
    crashed = np.ones(count, dtype=bool)
    crashed[running] = False
    # The drive is straight to a millimetre, and steps are shorter than a chord.
    assert crashed[nearest < 0.002].all()
    assert not crashed[nearest > 0.008].any()
    assert (nearest < 0.0).sum() > 20
    if shape != "wall":
        assert (nearest > 0.008).sum() >= 2


@every_shape
def test_who_stands_at_an_obstacle_and_pushes_collides_at_once(shape, indoor_at):
    task = gdrl_tasks.make_task("indoor", arena="scatter")
    reach = task.arena.shapes.half_size[SHAPES[shape], 0]
    touching = -(reach + FOOTPRINT_M + np.array([0.0, 0.001, 0.004]))
    for turned_deg in (0.0, 30.0, 80.0):
        poses = [(x, 0.0, np.radians(turned_deg)) for x in touching]
        layout = only(SHAPES[shape], np.array([0.0, 0.0, 1.0, 0.0]))
        worlds = indoor_at(poses, layout=layout, arena="scatter")
        result = worlds.step(np.full(3, STRAIGHT))
        assert (result.outcome == Outcome.COLLISION).all()
        assert (result.reward == -1.0).all()
        assert result.terminated.all()


def test_who_slides_along_a_wall_collides(indoor_at):
    # At less than a degree, so that it comes into the margin only after a metre.
    poses = [(-0.05 - FOOTPRINT_M - 0.012, -1.5, np.radians(89.0))]
    layout = only(SHAPES["wall"], np.array([0.0, 0.0, 1.0, 0.0]))
    worlds = indoor_at(poses, layout=layout, arena="scatter")
    outcomes = [Outcome.RUNNING]
    while outcomes[-1] == Outcome.RUNNING and len(outcomes) <= 30:
        outcomes.append(int(worlds.step(np.array([STRAIGHT])).outcome[0]))
    first = outcomes[1:].index(Outcome.COLLISION)
    # The 7 mm to the margin take 0.4 m, 22 steps.
    assert 19 <= first <= 25
    assert set(outcomes[:first]) == {Outcome.RUNNING}


@every_shape
@pytest.mark.parametrize(
    ("speed", "deepest_m"),
    [(0.15, 0.005), pytest.param(0.20, 0.007, marks=pytest.mark.full)],
)
def test_nobody_gets_through_an_obstacle(shape, speed, deepest_m, indoor_at, indoor_pose):
    """On and on, whatever the outcome: half of them straight, the others as they like."""
    count = 48
    worlds, _ = approaches(shape, count, indoor_at, speed_m_s=speed)
    shapes, places = worlds.task.arena.shapes, worlds.arrays["obstacles"]
    generator = np.random.default_rng(0)
    room = []
    for _ in range(50):
        anything = generator.integers(5, size=count)
        worlds.step(np.where(np.arange(count) % 2, STRAIGHT, anything))
        worlds.arrays["outcome"][:] = Outcome.RUNNING
        middle, _ = indoor_pose(worlds.qpos)
        room.append(gaps(middle, places, shapes))
        _, x, y, _ = worlds.qpos[:, 3:7].T
        upright = 1.0 - 2.0 * (x * x + y * y)
        assert np.degrees(np.arccos(upright)).max() < 4.0
    # Little more than a substep's way: the engine sees an obstacle only from inside.
    assert np.min(room) > -deepest_m
    assert (np.min(room, axis=0) < 0.0).sum() > 20


@every_arena
def test_the_engine_touches_what_the_layout_says(arena, indoor_pose):
    """Contacts of the engine's bumper against the footprint's gap, one by one."""
    environment = gdrl_tasks.load("indoor", random=0, arena=arena)
    generator = np.random.default_rng(1)
    model = environment.physics.model
    bumper = model.name2id("bumper", "geom")
    touching = 0
    for _ in range(6):
        environment.reset()
        suite_task, data = environment.task, environment.physics.data
        shapes, places = suite_task.task.arena.shapes, suite_task.arrays["obstacles"]
        near = np.flatnonzero(np.hypot(*places[0, :, :2].T) < 20.0)
        for number in generator.choice(near, 40):
            # About as far from the surface of a shape as its own size.
            half_size, at = shapes.half_size[number], places[0, number]
            own = generator.uniform(-1.0, 1.0, 2)
            own *= (half_size + generator.uniform(0.08, 0.18)) / np.abs(own).max()
            x, y = at[:2] + own[0] * at[2:] + own[1] * np.array([-at[3], at[2]])
            heading = generator.uniform(-np.pi, np.pi)
            data.qpos[:2] = x, y
            data.qpos[3:7] = np.cos(0.5 * heading), 0.0, 0.0, np.sin(0.5 * heading)
            environment.physics.forward()
            middle, _ = indoor_pose(data.qpos[None])
            (room,) = gaps(middle, places, shapes)
            pairs = np.array([(c.geom1, c.geom2) for c in data.contact])
            in_contact = bool(len(pairs)) and bool((pairs == bumper).any())
            one = np.zeros(1, dtype=np.int64)
            pose = suite_task.task.planar_pose(data.qpos[None])
            (collides,) = suite_task.task.collides(suite_task.arrays, one, *pose)
            if abs(room) > 1e-6:
                assert in_contact == (room < 0.0)
            if abs(room - MARGIN_M) > 1e-9:
                assert collides == (room < MARGIN_M)
            touching += in_contact
    assert 60 < touching < 200


def test_only_the_footprint_touches_obstacles_and_only_the_wheels_the_floor():
    model = gdrl_tasks.load("indoor").physics.model
    names = [model.id2name(number, "geom") for number in range(model.ngeom)]
    pairs = {
        (one, other)
        for i, one in enumerate(names)
        for j, other in enumerate(names)
        if model.geom_contype[i] & model.geom_conaffinity[j]
        and model.geom_bodyid[i] != model.geom_bodyid[j]
    }
    obstacles = {name for name in names if name.startswith("obstacle")}
    on_the_floor = {("floor", name) for name in ("left_tyre", "right_tyre", "caster")}
    assert len(obstacles) == 8
    assert pairs == on_the_floor | {(name, "bumper") for name in obstacles}


@pytest.mark.parametrize("at_limit", ["terminated", "truncated"])
def test_a_crash_is_the_end_on_both_routes(at_limit):
    options = {"arena": "paper", "at_limit": at_limit, "step_limit": 120}
    seeds = np.arange(12)
    worlds = gdrl_tasks.simulate("indoor", num_worlds=12, num_threads=1, seed=0, **options)
    worlds.reset(seeds=seeds)
    ends = {}
    for step in range(120):
        running = np.flatnonzero(worlds.arrays["outcome"] == Outcome.RUNNING)
        result = worlds.step(np.full(len(running), STRAIGHT), running)
        for row in np.flatnonzero(result.outcome == Outcome.COLLISION):
            ends[running[row]] = step
            assert result.terminated[row]
            assert not result.truncated[row]
            assert result.reward[row] == -1.0
    assert len(ends) >= 4
    environment = gdrl_tasks.load("indoor", **options)
    for world in list(ends)[:4]:
        environment.task.next_episode_seed = int(seeds[world])
        time_step = environment.reset()
        for _ in range(ends[world] + 1):
            assert not time_step.last()
            time_step = environment.step(STRAIGHT)
        assert time_step.last()
        assert environment.task.outcome == Outcome.COLLISION
        assert (time_step.reward, time_step.discount) == (-1.0, 0.0)
