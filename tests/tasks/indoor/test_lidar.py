"""The lidar against rays, circles and segments of analytic geometry."""

import mujoco
import numpy as np
import pytest

import gdrl_tasks

NEAREST_M, FARTHEST_M = 0.12, 3.5
STAND_STILL = np.array([-1.0, 0.0])
AWAY = [100.0, 100.0, 1.0, 0.0]


def distances_to_circle(origin, directions, middle, radius):
    """Distances along rays ``[B, 2]`` to a circle, infinite where they miss it."""
    offset = middle - origin
    along = directions @ offset
    # The ray's distance from the middle decides whether it hits.
    aside = offset[0] * directions[:, 1] - offset[1] * directions[:, 0]
    half_chord = np.sqrt(np.maximum(radius**2 - aside**2, 0.0))
    hits = (np.abs(aside) <= radius) & (along - half_chord >= 0.0)
    return np.where(hits, along - half_chord, np.inf)


def distances_to_segment(origin, directions, start, end):
    """Distances along rays ``[B, 2]`` to a segment, infinite where they miss it."""
    # origin + along * direction = start + fraction * (end - start), by Cramer's rule.
    side, offset = end - start, start - origin
    determinant = directions[:, 0] * side[1] - directions[:, 1] * side[0]
    parallel = np.abs(determinant) < 1e-12
    determinant = np.where(parallel, 1.0, determinant)
    along = (offset[0] * side[1] - offset[1] * side[0]) / determinant
    fraction = offset[0] * directions[:, 1] - offset[1] * directions[:, 0]
    fraction = fraction / determinant
    hits = ~parallel & (along >= 0.0) & (fraction >= 0.0) & (fraction <= 1.0)
    return np.where(hits, along, np.inf)


def expected_scan(pose, angles, places, shapes):
    """What a perfect lidar reads at (x, y, heading), ``[B]``."""
    origin, heading = np.array(pose[:2]), pose[2]
    directions = np.stack([np.cos(heading + angles), np.sin(heading + angles)], axis=-1)
    nearest = np.full(len(angles), np.inf)
    for place, is_box, half_size in zip(
        places, shapes.is_box, shapes.half_size, strict=True
    ):
        middle = place[:2]
        if np.hypot(*(middle - origin)) > 20.0:
            continue
        if not is_box:
            found = distances_to_circle(origin, directions, middle, half_size[0])
            nearest = np.minimum(nearest, found)
            continue
        along = half_size[0] * place[2:]
        across = half_size[1] * np.array([-place[3], place[2]])
        corners = [
            middle + along + across,
            middle - along + across,
            middle - along - across,
            middle + along - across,
        ]
        for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
            found = distances_to_segment(origin, directions, start, end)
            nearest = np.minimum(nearest, found)
    return np.clip(nearest, NEAREST_M, FARTHEST_M)


def angles_of(num_beams, field_of_view_deg):
    """Beams from right to left; those of a full circle begin behind and do not meet."""
    steps = num_beams - 1 if field_of_view_deg < 360.0 else num_beams
    first = -0.5 * field_of_view_deg
    return np.radians(first + np.arange(num_beams) * field_of_view_deg / steps)


@pytest.mark.parametrize("arena", ["paper", "scatter", "corridor", "trap"])
@pytest.mark.parametrize(
    ("num_beams", "field_of_view_deg"),
    [(19, 180.0), (36, 360.0), pytest.param(11, 73.5, marks=pytest.mark.full)],
)
def test_scans_are_those_of_a_perfect_lidar(
    arena, num_beams, field_of_view_deg, indoor_pose
):
    count = 12
    worlds = gdrl_tasks.simulate(
        "indoor",
        num_worlds=count,
        num_threads=1,
        seed=0,
        arena=arena,
        num_beams=num_beams,
        field_of_view_deg=field_of_view_deg,
    )
    angles = angles_of(num_beams, field_of_view_deg)
    generator = np.random.default_rng(num_beams)
    observation = worlds.reset(seeds=generator.integers(2**40, size=count))
    read = []
    for _ in range(4):
        middle, heading = indoor_pose(worlds.qpos)
        expected = [
            expected_scan(
                (*middle[k], heading[k]), angles, places, worlds.task.arena.shapes
            )
            for k, places in enumerate(worlds.arrays["obstacles"])
        ]
        read.append(FARTHEST_M * observation[:, 2:])
        np.testing.assert_allclose(read[-1], expected, rtol=0.0, atol=1e-9)
        for _ in range(5):
            observation = worlds.step(generator.integers(5, size=count)).observation
    assert np.ptp(read) > 2.0


@pytest.mark.parametrize("arena", ["paper", "scatter", "corridor", "trap"])
def test_the_dm_control_route_scans_alike(arena, indoor_pose):
    environment = gdrl_tasks.load("indoor", random=3, arena=arena)
    angles = angles_of(19, 180.0)
    generator = np.random.default_rng(0)
    for _ in range(8):
        time_step = environment.reset()
        for _ in range(3):
            middle, heading = indoor_pose(environment.physics.data.qpos)
            places = environment.task.arrays["obstacles"][0]
            shapes = environment.task.task.arena.shapes
            expected = expected_scan((*middle, heading), angles, places, shapes)
            read = FARTHEST_M * time_step.observation["lidar"]
            np.testing.assert_allclose(read, expected, rtol=0.0, atol=1e-9)
            time_step = environment.step(generator.integers(5))


@pytest.mark.parametrize("arena", ["paper", "scatter", "corridor", "trap"])
def test_the_engines_own_rays_hit_the_same(arena, indoor_pose):
    """What is drawn and what is solid is what the lidar sees, at the lidar's height."""
    environment = gdrl_tasks.load(
        "indoor", random=5, arena=arena, num_beams=45, field_of_view_deg=360.0
    )
    angles = angles_of(45, 360.0)
    physics = environment.physics
    model, data = physics.model.ptr, physics.data.ptr
    walls = [physics.model.name2id(f"obstacle_{number}", "geom") for number in range(4)]
    groups = np.zeros(6, dtype=np.uint8)
    groups[physics.model.geom_group[walls]] = 1
    generator = np.random.default_rng(0)
    hits = 0
    for _ in range(10):
        time_step = environment.reset()
        for _ in range(3):
            middle, heading = indoor_pose(physics.data.qpos)
            read = FARTHEST_M * time_step.observation["lidar"]
            for beam, angle in enumerate(heading + angles):
                ray = np.array([np.cos(angle), np.sin(angle), 0.0])
                origin = np.array([*middle, 0.18])
                geom = np.zeros(1, dtype=np.int32)
                hit = mujoco.mj_ray(model, data, origin, ray, groups, 1, -1, geom)
                hits += 0.0 <= hit <= FARTHEST_M
                seen = FARTHEST_M if hit < 0.0 else np.clip(hit, NEAREST_M, FARTHEST_M)
                assert read[beam] == pytest.approx(seen, abs=1e-9)
            time_step = environment.step(generator.integers(5))
    assert hits > 500


def only_walls(half_x, half_y):
    """A room of four walls whose inner faces are at +-x and +-y."""

    def layout(shapes, number):
        places = np.tile(AWAY, (len(shapes), 1))
        thick = 0.05
        places[:4, :2] = [
            (half_x + thick, 0.0),
            (-half_x - thick, 0.0),
            (0.0, half_y + thick),
            (0.0, -half_y - thick),
        ]
        return places

    return layout


def test_walls_come_and_go_as_the_robot_turns(indoor_at, indoor_pose):
    options = {"arena": "scatter", "actions": "continuous", "num_beams": 1}
    worlds = indoor_at([(0.3, -0.2, 0.0)], layout=only_walls(2.0, 1.5), **options)
    seen, headings = [], []
    for _ in range(36):
        observation = worlds.step(np.array([[-1.0, 1.0]])).observation
        (middle,), (heading,) = indoor_pose(worlds.qpos)
        # The nearest wall that it looks at, of those ahead in x and in y.
        with np.errstate(divide="ignore"):
            in_x = (np.copysign(2.0, np.cos(heading)) - middle[0]) / np.cos(heading)
            in_y = (np.copysign(1.5, np.sin(heading)) - middle[1]) / np.sin(heading)
        assert FARTHEST_M * observation[0, 2] == pytest.approx(min(in_x, in_y), abs=1e-9)
        seen.append(FARTHEST_M * observation[0, 2])
        headings.append(heading)
    assert np.ptp(np.unwrap(headings)) > 2.0 * np.pi
    assert min(seen) == pytest.approx(1.3, abs=0.05)
    assert max(seen) > 2.2


def one_cylinder(distance, bearing_deg=0.0):
    """A cylinder of 0.1 m whose surface is that far from the origin; no walls."""

    def layout(shapes, number):
        places = np.tile(AWAY, (len(shapes), 1))
        which = np.flatnonzero(shapes.half_size[:, 0] == 0.1)[0]
        bearing = np.radians(bearing_deg)
        middle = (distance + 0.1) * np.array([np.cos(bearing), np.sin(bearing)])
        places[which, :2] = middle
        return places

    return layout


@pytest.mark.parametrize(
    ("distance", "reading"),
    [
        (0.112, 0.12),
        (0.119, 0.12),
        (0.121, 0.121),
        (1.0, 1.0),
        (3.499, 3.499),
        (3.501, 3.5),
        (6.0, 3.5),
    ],
)
def test_ranges_end_at_the_data_sheets_limits(distance, reading, indoor_at):
    options = {"arena": "scatter", "actions": "continuous", "num_beams": 3}
    layout = one_cylinder(distance)
    worlds = indoor_at([(0.0, 0.0, 0.0)], layout=layout, **options)
    scan = FARTHEST_M * worlds.step(STAND_STILL[None]).observation[0, 2:]
    # It stands still but for a settling of its weight.
    assert scan == pytest.approx([FARTHEST_M, reading, FARTHEST_M], abs=1e-4)


@pytest.mark.parametrize("field_of_view_deg", [180.0, 360.0])
def test_nothing_in_sight_reads_the_farthest_range(field_of_view_deg, indoor_at):
    options = {"num_beams": 31, "field_of_view_deg": field_of_view_deg}
    worlds = indoor_at([(0.0, 0.0, 0.0), (1.0, 2.0, 3.0)], **options)
    for action in (0, 2, 4):
        observation = worlds.step(np.full(2, action)).observation
        np.testing.assert_array_equal(observation[:, 2:], 1.0)


@pytest.mark.parametrize("heading_deg", [0.0, 130.0, -90.0])
def test_beams_go_from_right_to_left(heading_deg, indoor_at):
    pose = [(0.0, 0.0, np.radians(heading_deg))]
    options = {"arena": "scatter", "actions": "continuous", "num_beams": 5}
    for beam, side_deg in enumerate([-90.0, -45.0, 0.0, 45.0, 90.0]):
        layout = one_cylinder(1.0, heading_deg + side_deg)
        worlds = indoor_at(pose, layout=layout, **options)
        scan = worlds.step(STAND_STILL[None]).observation[0, 2:]
        assert scan[beam] == pytest.approx(1.0 / FARTHEST_M, abs=1e-4)
        np.testing.assert_array_equal(np.delete(scan, beam), 1.0)


@pytest.mark.parametrize("field_of_view_deg", [180.0, 360.0])
def test_a_lone_beam_looks_ahead(field_of_view_deg, indoor_at):
    options = {
        "arena": "scatter",
        "actions": "continuous",
        "num_beams": 1,
        "field_of_view_deg": field_of_view_deg,
    }
    worlds = indoor_at([(0.0, 0.0, 0.0)], layout=one_cylinder(1.0), **options)
    scan = worlds.step(STAND_STILL[None]).observation[0, 2:]
    assert scan == pytest.approx([1.0 / FARTHEST_M], abs=1e-4)


@pytest.mark.parametrize("interval_cs", [4, 12, 20, 30])
def test_a_held_scan_is_the_last_of_five_a_second(interval_cs):
    options = {"control_interval_s": interval_cs / 100}
    always, held = (
        gdrl_tasks.simulate(
            "indoor", num_worlds=8, num_threads=1, seed=0, scan_hold=hold, **options
        )
        for hold in (False, True)
    )
    seeds = np.arange(8)
    expected = always.reset(seeds=seeds)[:, 2:]
    np.testing.assert_array_equal(held.reset(seeds=seeds)[:, 2:], expected)
    generator = np.random.default_rng(0)
    scans_so_far = changes = 0
    for step in range(1, 31):
        action = generator.integers(5, size=8)
        fresh = always.step(action).observation
        seen = held.step(action).observation
        for worlds in (always, held):  # They go on, whatever the outcome.
            worlds.arrays["outcome"][:] = 0
        # Centiseconds are integers: the lidar has turned once every 20 of them.
        turns = step * interval_cs // 20
        if turns > scans_so_far:
            scans_so_far, expected = turns, fresh[:, 2:]
            changes += 1
        else:
            assert (fresh[:, 2:] != expected).any()
        np.testing.assert_array_equal(seen[:, 2:], expected)
        np.testing.assert_array_equal(seen[:, :2], fresh[:, :2])
    assert changes == min(30, 30 * interval_cs // 20)


def test_a_reset_scans_at_once_even_with_a_held_scan():
    worlds = gdrl_tasks.simulate(
        "indoor", num_worlds=2, num_threads=1, seed=0, scan_hold=True
    )
    fresh = gdrl_tasks.simulate("indoor", num_worlds=1, num_threads=1, seed=0)
    worlds.reset(seeds=np.array([1, 2]))
    worlds.step(np.array([2, 2]))
    observation = worlds.reset(np.array([1]), np.array([3]))
    np.testing.assert_array_equal(observation, fresh.reset(seeds=np.array([3])))
    np.testing.assert_array_equal(worlds.observe(np.array([1])), observation)


def noise_samples(indoor_at, *, num_scans=300, **options):
    """True ranges and errors of robots that stand still, ``[num_scans, W, B]`` each."""
    poses = [(x, y, 0.7) for x in (-1.6, -0.3, 0.9) for y in (-1.0, 0.0, 0.8, 1.15)]
    common = {
        "arena": "scatter",
        "actions": "continuous",
        "num_beams": 24,
        "field_of_view_deg": 360.0,
    }
    walls = only_walls(2.0, 1.5)
    true, noisy = (
        indoor_at(poses, layout=walls, range_noise=noise, **common | options)
        for noise in (False, True)
    )
    action = np.tile(STAND_STILL, (len(poses), 1))
    ranges = [true.step(action).observation[:, 2:] for _ in range(num_scans)]
    readings = [noisy.step(action).observation[:, 2:] for _ in range(num_scans)]
    ranges = FARTHEST_M * np.array(ranges)
    return ranges, FARTHEST_M * np.array(readings) - ranges


def test_range_noise_is_as_precise_as_the_data_sheet(indoor_at):
    ranges, errors = noise_samples(indoor_at)
    # Where the limits of the range cut nothing off, four deviations away.
    inside = (ranges > 0.16) & (ranges * 1.14 < FARTHEST_M)
    near, far = inside & (ranges < 0.499), inside & (ranges >= 0.5)
    for where, deviation in ((near, np.full_like(ranges, 0.010)), (far, 0.035 * ranges)):
        relative = (errors / deviation)[where]
        assert relative.size > 5000
        tolerance = 4.0 / np.sqrt(relative.size)
        assert relative.mean() == pytest.approx(0.0, abs=tolerance)
        assert relative.std() == pytest.approx(1.0, abs=tolerance)
        # Normal, as errors are: one in 22 lies beyond two deviations.
        beyond = (np.abs(relative) > 2.0).mean()
        assert beyond == pytest.approx(0.0455, abs=0.25 * tolerance)
    readings = ranges + errors
    assert readings.min() >= NEAREST_M - 1e-12
    assert readings.max() <= FARTHEST_M + 1e-12


def test_range_noise_differs_by_beam_by_scan_and_by_episode(indoor_at):
    ranges, errors = noise_samples(indoor_at)
    usable = (ranges > 0.5) & (ranges < 3.0)
    relative = np.where(usable, errors / (0.035 * ranges), np.nan)
    for one, other in (
        (relative[1:], relative[:-1]),
        (relative[:, 1:], relative[:, :-1]),
        (relative[..., 1:], relative[..., :-1]),
    ):
        products = (one * other)[np.isfinite(one * other)]
        assert products.size > 10_000
        tolerance = 4.0 / np.sqrt(products.size)
        assert products.mean() == pytest.approx(0.0, abs=tolerance)


def test_a_held_scan_is_held_with_its_noise(indoor_at):
    _, errors = noise_samples(indoor_at, num_scans=20, scan_hold=True)
    changed = (np.diff(errors, axis=0) != 0.0).any(axis=(1, 2))
    # Steps 2 to 20 end at 24, 36, ... 240 centiseconds, a scan is due every 20.
    due = np.diff(12 * np.arange(1, 21) // 20) > 0
    np.testing.assert_array_equal(changed, due)


def test_range_noise_belongs_to_the_episode():
    def scans(seed, *, num_worlds, warm_up=0):
        worlds = gdrl_tasks.simulate(
            "indoor", num_worlds=num_worlds, num_threads=1, seed=0, range_noise=True
        )
        worlds.reset()
        for _ in range(warm_up):
            worlds.step(np.full(num_worlds, 2))
        last = np.array([num_worlds - 1])
        seen = [worlds.reset(last, np.array([seed]))]
        seen += [worlds.step(np.array([2]), last).observation for _ in range(4)]
        return np.concatenate(seen)[:, 2:]

    np.testing.assert_array_equal(scans(7, num_worlds=1), scans(7, num_worlds=4, warm_up=3))
    assert (scans(7, num_worlds=1) != scans(8, num_worlds=1)).any()
