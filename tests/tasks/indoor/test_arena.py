"""Every episode that is drawn can be driven, and drives stay sound for long."""

import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import Outcome
from gdrl_tasks.controllers import pursue_goal
from gdrl_tasks.indoor.arena import CorridorArena

START_ROOM_M = 0.4
GOAL_ROOM_M = 0.3
FARTHEST_GOAL_M = {"paper": 9.9, "scatter": 9.9, "corridor": 11.1, "trap": 2.6}
LEAST_WAY_M = {"paper": 0.5, "scatter": 1.0, "corridor": 5.0, "trap": 1.0}
INSIDE_M = {
    "paper": (3.5, 3.5),
    "scatter": (3.5, 3.5),
    "corridor": (5.25, 1.75),
    "trap": (3.5, 3.5),
}
every_arena = pytest.mark.parametrize("arena", list(INSIDE_M))


def room_around(points, places, shapes):
    """Distances of points ``[E, 2]`` to what is nearest in their layouts, ``[E]``."""
    nearest = np.full(len(points), np.inf)
    for number, (is_box, half_size) in enumerate(
        zip(shapes.is_box, shapes.half_size, strict=True)
    ):
        x, y, cosine, sine = places[:, number].T
        dx, dy = points[:, 0] - x, points[:, 1] - y
        if is_box:
            # Beyond a side, or beyond a corner: the nearest point of the box is there.
            own = np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx], axis=-1)
            distance = np.linalg.norm(own - own.clip(-half_size, half_size), axis=-1)
        else:
            distance = np.maximum(np.hypot(dx, dy) - half_size[0], 0.0)
        nearest = np.minimum(nearest, distance)
    return nearest


def draw(arena, seeds, **options):
    """Task and drawn episodes, stacked by name."""
    task = gdrl_tasks.make_task("indoor", arena=arena, **options)
    episodes = [task.draw_episode(int(seed)) for seed in seeds]
    drawn = {
        name: np.array([episode.arrays[name] for episode in episodes])
        for name in ("goal", "obstacles", "shortest_path")
    }
    drawn["qpos"] = np.array([episode.qpos for episode in episodes])
    drawn["qvel"] = np.array([episode.qvel for episode in episodes])
    return task, drawn


@pytest.mark.parametrize(
    ("arena", "count"),
    [
        *[(arena, 120) for arena in INSIDE_M],
        pytest.param("paper", 4000, marks=pytest.mark.full),
        pytest.param("scatter", 4000, marks=pytest.mark.full),
        pytest.param("corridor", 2000, marks=pytest.mark.full),
        pytest.param("trap", 2000, marks=pytest.mark.full),
    ],
)
def test_every_start_and_every_goal_has_room(arena, count, indoor_pose):
    task, drawn = draw(arena, 1000 + np.arange(count))
    start, heading = indoor_pose(drawn["qpos"])
    goal, places = drawn["goal"], drawn["obstacles"]
    shapes = task.arena.shapes
    assert (room_around(start, places, shapes) >= START_ROOM_M - 1e-9).all()
    assert (room_around(goal, places, shapes) >= GOAL_ROOM_M - 1e-9).all()
    for points in (start, goal):
        assert (np.abs(points) < INSIDE_M[arena]).all()
    way = np.hypot(*(goal - start).T)
    axle = drawn["qpos"][:, :2]
    assert (np.hypot(*(goal - axle).T) > task.goal_tolerance_m).all()
    assert (way >= LEAST_WAY_M[arena] + task.goal_tolerance_m).all()
    assert (drawn["shortest_path"] >= way - 1e-9).all()
    assert np.isfinite(drawn["shortest_path"]).all()
    assert (drawn["shortest_path"] <= 2.5 * FARTHEST_GOAL_M[arena]).all()
    assert (drawn["qvel"] == 0.0).all()
    assert (drawn["qpos"][:, [4, 5, 7, 8]] == 0.0).all()
    # Eight sectors of headings, each as likely: within five standard deviations.
    sectors = np.bincount(
        ((heading + np.pi) // (0.25 * np.pi)).astype(int) % 8, minlength=8
    )
    assert np.abs(sectors - count / 8).max() <= 5.0 * np.sqrt(count * 7 / 64)


@every_arena
def test_every_seed_is_an_episode_of_its_own(arena):
    seeds = np.array([3, 4, 2**40, 2**62 + 5])
    _, first = draw(arena, seeds)
    _, again = draw(arena, seeds[::-1])
    for name, value in first.items():
        np.testing.assert_array_equal(value, again[name][::-1])
    for name in ("goal", "obstacles", "qpos", "shortest_path"):
        flat = first[name].reshape(len(seeds), -1)
        assert len(np.unique(flat, axis=0)) == len(seeds)


def test_no_option_of_the_robot_changes_the_episodes_of_a_seed():
    seeds = np.arange(8)
    _, plain = draw("scatter", seeds)
    options = {"actions": "continuous", "num_beams": 5, "speed_m_s": 0.1, "step_limit": 9}
    _, other = draw("scatter", seeds, range_noise=True, scan_hold=True, **options)
    for name, value in plain.items():
        np.testing.assert_array_equal(value, other[name])


@every_arena
@pytest.mark.parametrize("tolerance", [0.05, 0.5])
def test_the_start_is_outside_of_a_goal_of_any_size(arena, tolerance):
    task, drawn = draw(arena, np.arange(60), goal_tolerance_m=tolerance)
    way = np.hypot(*(drawn["goal"] - drawn["qpos"][:, :2]).T)
    assert (way > tolerance + LEAST_WAY_M[arena] - 0.05).all()
    assert task.goal_tolerance_m == tolerance


def test_the_papers_blocks_stand_around_the_start_a_little_displaced():
    task, drawn = draw("paper", np.arange(200))
    blocks = drawn["obstacles"][:, 4:]
    middles = np.array([[0.0, 1.4], [0.0, -1.4], [2.3, 0.0], [-2.3, 0.0]])
    moved = blocks[..., :2] - middles
    assert np.abs(moved).max() <= 0.15
    assert (moved.max(axis=0) > 0.13).all()
    assert (moved.min(axis=0) < -0.13).all()
    sizes = 2.0 * task.arena.shapes.half_size[4:]
    np.testing.assert_allclose(sizes, [[2.2, 0.5]] * 2 + [[0.3, 2.2]] * 2)
    assert (np.hypot(*drawn["qpos"][:, :2].T) < 0.62).all()
    # Goals are on every side, beyond the blocks too.
    goal = drawn["goal"]
    for axis in (0, 1):
        assert goal[:, axis].max() > 2.8
        assert goal[:, axis].min() < -2.8


def test_six_to_ten_obstacles_are_scattered_at_any_angle():
    _, drawn = draw("scatter", np.arange(200))
    places = drawn["obstacles"][:, 4:]
    present = np.hypot(places[..., 0], places[..., 1]) < 10.0
    assert set(present.sum(axis=1)) == {6, 7, 8, 9, 10}
    assert present.mean(axis=0).min() > 0.6
    # Those left out are out of sight from anywhere.
    assert np.hypot(*np.moveaxis(places[~present][:, :2], -1, 0)).min() > 50.0
    yaw = np.arctan2(places[..., 3], places[..., 2])[present]
    assert np.hypot(places[..., 2], places[..., 3]) == pytest.approx(1.0)
    assert np.histogram(yaw, bins=4, range=(-np.pi, np.pi))[0].min() > 0.2 * len(yaw)


def test_the_corridor_is_driven_from_end_to_end():
    _, drawn = draw("corridor", np.arange(100))
    assert (drawn["qpos"][:, 0] < -4.0).all()
    assert (drawn["goal"][:, 0] > 4.0).all()
    assert (drawn["shortest_path"] > 8.0).all()
    sides = np.sign(drawn["obstacles"][:, 4:7, 1])
    assert len(np.unique(sides, axis=0)) == 8


def in_the_frame_of_the_trap(points, bottom):
    """Points ``[E, K, 2]`` from the middle of the bottom; x leads out of its back."""
    x, y, cosine, sine = (value[:, None] for value in bottom.T)
    dx, dy = points[..., 0] - x, points[..., 1] - y
    return np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx], axis=-1)


def test_the_trap_is_a_u_between_start_and_goal_turned_any_way(indoor_pose):
    task, drawn = draw("trap", np.arange(200))
    bottom, first, second = np.moveaxis(drawn["obstacles"][:, 4:], 1, 0)
    assert len(task.arena.shapes) == 7
    corners = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    ends = []
    for number, places in enumerate((bottom, first, second), start=4):
        own = corners * task.arena.shapes.half_size[number]
        x, y, cosine, sine = (value[:, None] for value in places.T)
        in_world = np.stack(
            [
                x + cosine * own[:, 0] - sine * own[:, 1],
                y + sine * own[:, 0] + cosine * own[:, 1],
            ],
            axis=-1,
        )
        ends.append(in_the_frame_of_the_trap(in_world, bottom))
    # Outside it is 2.4 m wide and 1.2 m deep; its sides end at its bottom.
    everything = np.concatenate(ends, axis=1)
    np.testing.assert_allclose(np.ptp(everything, axis=1), [[1.2, 2.4]] * 200)
    np.testing.assert_allclose(ends[1][..., 0].max(axis=1), -0.05, atol=1e-9)
    np.testing.assert_allclose(ends[2][..., 0].max(axis=1), -0.05, atol=1e-9)
    start, _ = indoor_pose(drawn["qpos"])
    both = np.stack([start, drawn["goal"]], axis=1)
    ((before, beside), (behind, across)) = np.moveaxis(
        in_the_frame_of_the_trap(both, bottom), 0, -1
    )
    # The mouth is 1.15 m before the bottom, and the goal a metre behind it.
    assert np.abs(before + 1.0).max() < 0.3
    assert np.abs(behind - 1.0).max() < 0.4
    assert np.abs([beside, across]).max() < 0.5
    # Whoever gets out of the U has to go farther away from the goal than the start is.
    away = np.linalg.norm(both[:, :1] - both[:, 1:], axis=-1)
    for side in (first, second):
        end = side[:, :2] - 0.55 * side[:, 2:]
        assert (np.linalg.norm(end - drawn["goal"], axis=-1) > away[:, 0] + 0.1).all()
    yaw = np.arctan2(bottom[:, 3], bottom[:, 2])
    assert np.histogram(yaw, bins=4, range=(-np.pi, np.pi))[0].min() > 25
    assert (np.ptp(bottom[:, :2], axis=0) > 1.5).all()


def test_progress_leads_into_the_trap():
    count = 24
    worlds = gdrl_tasks.simulate(
        "indoor", num_worlds=count, num_threads=1, seed=0, arena="trap"
    )
    observation, running = worlds.reset(seeds=np.arange(count)), np.arange(count)
    while len(running):
        result = worlds.step(pursue_goal(observation), running)
        goes_on = result.outcome == Outcome.RUNNING
        running, observation = running[goes_on], result.observation[goes_on]
    # Nobody gets to the goal, though they are paid for coming nearer.
    assert (worlds.arrays["outcome"] == Outcome.COLLISION).all()
    assert np.median(worlds.arrays["distance"]) < 1.5
    assert np.median(worlds.arrays["episode_return"]) > 5.0


class OftenShut(CorridorArena):
    """A corridor whose first layouts are shut off in the middle."""

    def __init__(self, shut):
        super().__init__()
        self.shut = shut

    def draw_obstacles(self, generator):
        places = super().draw_obstacles(generator)
        if self.shut > 0:
            self.shut -= 1
            places[:3, 0] = 0.0
            places[:3, 1] = -1.1, 0.0, 1.1
        return places


def test_a_layout_without_a_way_is_drawn_again():
    arena = OftenShut(shut=5)
    scene = arena.draw(np.random.default_rng(0), 0.115, 0.15)
    assert arena.shut == 0
    assert np.isfinite(scene.shortest_path_m)
    assert np.abs(scene.places[4:7, 0]).max() > 2.0
    with pytest.raises(RuntimeError, match=r"'corridor': no layout in 1000 had a way"):
        OftenShut(shut=10**6).draw(np.random.default_rng(0), 0.115, 0.15)


def drive_at_random(count, steps, **options):
    """Worlds after every step of a long drive, ended ones begun anew."""
    worlds = gdrl_tasks.simulate(
        "indoor", num_worlds=count, num_threads=1, seed=0, **options
    )
    worlds.reset()
    spec = worlds.task.spec
    generator = np.random.default_rng(0)
    for step in range(steps):
        if step % 5 == 0:
            if spec.is_discrete:
                action = generator.integers(spec.action_size, size=count)
            else:
                action = generator.uniform(-1.0, 1.0, (count, 2))
        result = worlds.step(action)
        yield worlds, result
        ended = np.flatnonzero(result.terminated | result.truncated)
        assert np.isfinite(worlds.reset(ended)).all()


@pytest.mark.parametrize(
    ("count", "steps", "options"),
    [
        (24, 200, {"arena": "scatter"}),
        (24, 200, {"arena": "corridor", "speed_m_s": 0.20, "scan_hold": True}),
        (24, 200, {"actions": "continuous", "range_noise": True}),
        pytest.param(60, 2000, {}, marks=pytest.mark.full),
        pytest.param(
            60, 2000, {"arena": "scatter", "speed_m_s": 0.20}, marks=pytest.mark.full
        ),
    ],
    ids=str,
)
def test_a_long_drive_stays_upright_and_on_the_floor(count, steps, options):
    speed = options.get("speed_m_s", 0.15)
    outcomes = []
    for worlds, result in drive_at_random(count, steps, **options):
        assert np.isfinite(worlds.qpos).all()
        assert np.isfinite(worlds.qvel).all()
        assert np.isfinite(result.observation).all()
        low, high = worlds.task.spec.observation_bounds
        assert (low <= result.observation).all()
        assert (result.observation <= high).all()
        assert np.isfinite(result.reward).all()
        _, x, y, _ = worlds.qpos[:, 3:7].T
        tilt_deg = np.degrees(np.arccos(1.0 - 2.0 * (x * x + y * y)))
        free = result.outcome == Outcome.RUNNING
        # The tyres' middles are their radius above the floor, less what they give.
        assert np.abs(worlds.qpos[free, 2] - 0.0325).max(initial=0.0) < 1e-3
        assert tilt_deg[free].max(initial=0.0) < 1.0
        # At a crash the nose dips.
        assert tilt_deg.max() < (2.0 if speed <= 0.15 else 4.0)
        outcomes.append(result.outcome)
    seen, counts = np.unique(outcomes, return_counts=True)
    ends = dict(zip(seen.tolist(), counts.tolist(), strict=True))
    assert Outcome.DIVERGED not in ends
    assert ends[Outcome.COLLISION] > 0.1 * count


@every_arena
def test_the_shortest_way_ends_at_the_goals_edge(arena):
    worlds = gdrl_tasks.simulate("indoor", num_worlds=5, num_threads=1, seed=0, arena=arena)
    seeds = np.arange(5)
    worlds.reset(seeds=seeds)
    task, drawn = draw(arena, seeds)
    expected = drawn["shortest_path"] - task.goal_tolerance_m
    np.testing.assert_allclose(worlds.arrays["shortest_path"], expected)
