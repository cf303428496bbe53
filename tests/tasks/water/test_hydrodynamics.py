"""The hull floats, swings, drives and drifts as its equations say."""

import itertools
import math

import mujoco
import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import Stream, episode_seeds
from gdrl_tasks.controllers import pursuit
from gdrl_tasks.water import definition, waves
from gdrl_tasks.water.hull import GRAVITY_M_S2, WATER_DENSITY_KG_M3
from gdrl_tasks.water.options import WaterOptions
from gdrl_tasks.water.task import WaterTask
from tests.oracles.waves import orbital_velocity
from tests.tasks.water.hulls import HULL, NUM_WORLDS, SUBSTEP_S, array_wrench, random_state


def cross_matrix(vector):
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def fossen_acceleration(hull, qpos, qvel, thrust):
    """Body-frame accelerations in still water, by the equations in matrix form.

    M dnu/dt = tau - C(nu) nu - D(nu) nu - g, for one world. What the water does counts by
    the share of the hull that is in it. Added mass has no Munk moment, and in the forces
    the Coriolis matrix of a mass of the same size in all directions.
    """
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, qpos[3:])
    rotation = rotation.reshape(3, 3)
    linear, angular = rotation.T @ qvel[:3], qvel[3:]
    nu = np.concatenate([linear, angular])
    force = -hull.mass_kg * GRAVITY_M_S2 * rotation[2]
    tau, shares, wetting = np.concatenate([force, np.zeros(3)]), [], []
    for point in hull.points:
        height = qpos[2] + rotation[2] @ point
        wetted = min(max(0.5 * hull.draft_m - height, 0.0), hull.depth_m)
        share = min(2.0 * wetted / hull.draft_m, 1.0)
        lift = WATER_DENSITY_KG_M3 * GRAVITY_M_S2 * hull.point_area_m2 * wetted
        speed = rotation[2] @ (linear + np.cross(angular, point))
        up = (lift - share * hull.point_damping * speed) * rotation[2]
        tau += np.concatenate([up, np.cross(point, up)])
        shares.append(share)
        wetting.append(-2.0 * speed / hull.draft_m if 0.0 < share < 1.0 else 0.0)
    share = np.mean(shares)
    rigid = np.concatenate([np.full(3, hull.mass_kg), hull.inertia])
    water = share * hull.added_mass
    coriolis = np.zeros((6, 6))
    for mass, moment, both in (
        (rigid[:3], rigid[3:], True),
        (np.full(3, water[0]), water[3:], False),
    ):
        coriolis[:3, 3:] -= cross_matrix(mass * linear)
        coriolis[3:, 3:] -= cross_matrix(moment * angular)
        if both:
            coriolis[3:, :3] -= cross_matrix(mass * linear)
    drag = share * (hull.linear_damping + hull.quadratic_damping * np.abs(nu))
    drag[2:5] = 0.0  # These act at the hull points.
    drag += max(np.mean(wetting), 0.0) * hull.added_mass
    # The first half of the points is the starboard hull, and its first is the stern.
    thrust = thrust * [shares[len(shares) // 2], shares[0]] * (rotation[2, 2] > 0.0)
    turn = hull.lever_m * (thrust[1] - thrust[0])
    tau += [thrust.sum(), 0.0, 0.0, 0.0, hull.thrust_height_m * thrust.sum(), turn]
    return (tau - drag * nu - coriolis @ nu) / (rigid + water)


def test_mujoco_moves_with_the_acceleration_of_fossens_equations():
    state = random_state(4, still_water=True)
    state.time[:] = 1.0
    # An infinitely short substep: no damping at its middle.
    wrench, _ = array_wrench(state, substep_s=1e-9)
    mean, _ = definition.advance_thrust(HULL, state.thrust, state.command, 1e-9, False)
    task = WaterTask(WaterOptions(sea="calm"))
    model = mujoco.MjModel.from_xml_string(task.xml())
    data = mujoco.MjData(model)
    for world in range(NUM_WORLDS):
        data.qpos, data.qvel = state.qpos[world], state.qvel[world]
        data.xfrc_applied[-1] = wrench[world]
        mujoco.mj_forward(model, data)
        rotation = data.xmat[-1].reshape(3, 3)
        linear, angular = rotation.T @ data.qvel[:3], data.qvel[3:]
        moved = rotation.T @ data.qacc[:3] - np.cross(angular, linear)
        expected = fossen_acceleration(
            HULL, state.qpos[world], state.qvel[world], mean[world]
        )
        np.testing.assert_allclose(moved, expected[:3], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(data.qacc[3:], expected[3:], rtol=1e-6, atol=1e-6)


def simulate(num_worlds=1, **options):
    options = {"sea": "calm", "step_limit": 10_000} | options
    return gdrl_tasks.simulate(
        "water", num_worlds=num_worlds, num_threads=1, seed=0, **options
    )


def test_displacement_at_the_draft_is_the_mass():
    area = HULL.point_area_m2 * len(HULL.points)
    assert WATER_DENSITY_KG_M3 * area * HULL.draft_m == pytest.approx(HULL.mass_kg)


def test_sixty_seconds_at_rest_stay_at_rest():
    worlds = simulate(4)
    worlds.reset()
    start = worlds.qpos.copy()
    for _ in range(240):
        worlds.step(np.zeros((4, 2)))
    np.testing.assert_allclose(worlds.qpos, start, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(worlds.qvel, 0.0, atol=1e-9)


def test_a_pushed_hull_comes_back_to_its_draft_and_level():
    worlds = simulate(1)
    worlds.reset()
    worlds.qpos[0] = [0.0, 0.0, worlds.qpos[0, 2] + 0.03, 1.0, 0.05, 0.05, 0.0]
    for _ in range(80):
        worlds.step(np.zeros((1, 2)))
    assert worlds.qpos[0, 2] == pytest.approx(worlds.task.rest_height_m, abs=1e-5)
    keel = worlds.qpos[0, 2] + HULL.points[0, 2] - 0.5 * HULL.draft_m
    assert keel == pytest.approx(-HULL.draft_m, abs=1e-5)
    np.testing.assert_allclose(worlds.qpos[0, 4:6], 0.0, atol=1e-5)


def energy(qpos, velocity):
    """Kinetic (added mass included) and potential energy in still water, J."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, qpos[3:])
    rotation = rotation.reshape(3, 3)
    nu = np.concatenate([rotation.T @ velocity[:3], velocity[3:]])
    mass = np.concatenate([np.full(3, HULL.mass_kg), HULL.inertia]) + HULL.added_mass
    height = qpos[2] + HULL.points @ rotation[2]
    wetted = np.clip(0.5 * HULL.draft_m - height, 0.0, HULL.depth_m)
    spring = 0.5 * WATER_DENSITY_KG_M3 * GRAVITY_M_S2 * HULL.point_area_m2
    potential = HULL.mass_kg * GRAVITY_M_S2 * qpos[2] + spring * (wetted**2).sum()
    return 0.5 * (mass * nu**2).sum() + potential


@pytest.mark.parametrize(
    ("start", "coordinate", "speed"),
    [
        ([0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0], 2, 2),
        ([0.0, 0.0, 0.0, 1.0, 0.06, 0.0, 0.0], 4, 3),
        ([0.0, 0.0, 0.0, 1.0, 0.0, 0.05, 0.0], 5, 4),
    ],
    ids=["heave", "roll", "pitch"],
)
def test_energy_at_extremes_of_a_free_oscillation_never_grows(start, coordinate, speed):
    worlds = simulate(1, control_interval_s=SUBSTEP_S)
    worlds.reset()
    rest = worlds.task.rest_height_m
    worlds.qpos[0] = start
    worlds.qpos[0, 2] += rest
    worlds.qpos[0, 3:] /= np.linalg.norm(worlds.qpos[0, 3:])
    lowest = energy(np.array([0.0, 0.0, rest, 1.0, 0.0, 0.0, 0.0]), np.zeros(6))
    states = [(worlds.qpos[0].copy(), worlds.qvel[0].copy())]
    for _ in range(400):
        worlds.step(np.zeros((1, 2)))
        states.append((worlds.qpos[0].copy(), worlds.qvel[0].copy()))
    extremes = [energy(*states[0]) - lowest]
    for (qpos, before), (_, after) in itertools.pairwise(states[1:]):
        # A leapfrog: the velocity at a position is the mean of its neighbours.
        if before[speed] * after[speed] <= 0.0:
            extremes.append(energy(qpos, 0.5 * (before + after)) - lowest)
    assert len(extremes) > 6
    extremes = np.array(extremes)
    assert extremes[0] > 0.1
    assert (extremes[1:] <= extremes[:-1] + 1e-9).all()
    assert extremes[-1] < 0.01 * extremes[0]
    assert abs(states[-1][0][coordinate] - (rest if coordinate == 2 else 0.0)) < 0.01


def drive(command, *, seconds=30.0, **options):
    """Distance ahead, speed ahead and yaw rate after a constant command."""
    worlds = simulate(1, **options)
    worlds.reset()
    for _ in range(round(seconds / 0.25)):
        before = worlds.qpos[0, :2].copy()
        worlds.step(np.array([command], dtype=float))
        worlds.arrays["outcome"][:] = 0  # It goes on, whatever the outcome.
    _, yaw = worlds.task.planar_pose(worlds.qpos)
    ahead = np.array([math.cos(yaw[0]), math.sin(yaw[0])])
    return (worlds.qpos[0, :2] - before) @ ahead / 0.25, worlds.qvel[0, 5]


def test_terminal_speed_is_that_of_the_identified_model():
    speed, yaw_rate = drive((1.0, 1.0))
    assert speed == pytest.approx(math.sqrt(2.0 * 22.5 / 17.26), rel=0.05)
    assert yaw_rate == pytest.approx(0.0, abs=1e-9)


def test_there_is_less_thrust_astern_than_ahead():
    speed, _ = drive((-1.0, -1.0))
    assert speed == pytest.approx(-math.sqrt(2.0 * 4.5 / 17.26), rel=0.05)


def test_more_thrust_to_starboard_turns_to_port():
    _, yaw_rate = drive((0.5, 1.0))
    assert yaw_rate > 0.1
    _, mirrored = drive((1.0, 0.5))
    assert mirrored == pytest.approx(-yaw_rate, rel=1e-6)


def test_commands_in_the_dead_zone_do_nothing_unless_it_is_compensated():
    speed, _ = drive((HULL.dead_zone, HULL.dead_zone), seconds=10.0)
    assert speed == pytest.approx(0.0, abs=1e-9)
    compensated, _ = drive((0.4, 0.4), seconds=30.0, dead_zone_compensated=True)
    assert compensated == pytest.approx(math.sqrt(2.0 * 0.4 * 22.5 / 17.26), rel=0.05)
    just_above, _ = drive((0.5, 0.5), seconds=30.0)
    assert just_above == pytest.approx(math.sqrt(2.0 * 22.5 / 6.0 / 17.26), rel=0.05)


@pytest.mark.parametrize(("command", "target"), [(1.0, 22.5), (-1.0, -4.5), (0.7, 11.25)])
@pytest.mark.parametrize("substep_s", [0.005, 0.025, 0.1])
def test_thrust_lags_exponentially_whatever_the_substep(command, target, substep_s):
    thrust = np.full((1, 2), 3.0)
    impulse = 0.0
    for _ in range(round(0.2 / substep_s)):
        mean, thrust = definition.advance_thrust(
            HULL, thrust, np.full((1, 2), command), substep_s, False
        )
        impulse += mean[0, 0] * substep_s
    left = math.exp(-0.2 / HULL.thrust_lag_s)
    assert thrust[0, 0] == pytest.approx(target + (3.0 - target) * left)
    exact = 0.2 * target + (3.0 - target) * HULL.thrust_lag_s * (1.0 - left)
    assert impulse == pytest.approx(exact)


def test_a_current_carries_a_drifting_hull():
    worlds = simulate(1, current_m_s=0.5)
    worlds.reset()
    for _ in range(400):
        worlds.step(np.zeros((1, 2)))
    current = worlds.arrays["current"][0]
    assert np.linalg.norm(current) == pytest.approx(0.5)
    np.testing.assert_allclose(worlds.qvel[0, :2], current, atol=0.05)


def test_a_very_long_wave_moves_the_hull_with_the_surface():
    period, height = 25.0, 0.8
    worlds = simulate(
        1, significant_wave_height_m=height, peak_period_s=period, wave_components=1
    )
    worlds.reset(seeds=np.array([3]))
    sea = {name: worlds.arrays[name] for name in waves.SEA_FIELDS}
    # The hull starts at rest: choose the phase at which the water does, too.
    sea["phase"][:] = 0.5 * math.pi
    worlds.qpos[0, 2] = worlds.task.rest_height_m
    rise, follow, water = [], [], []
    for step in range(1, 201):
        worlds.step(np.zeros((1, 2)))
        time = np.array([0.25 * step])
        x, y = worlds.qpos[:, 0:1], worlds.qpos[:, 1:2]
        surface = definition.elevation(sea, x, y, time)
        rise.append(worlds.qpos[0, 2] - worlds.task.rest_height_m - surface[0, 0])
        velocity = orbital_velocity(sea, x, y, surface - HULL.draft_m / 2, time)
        follow.append(worlds.qvel[0, :3].copy())
        water.append(velocity[0, 0])
    amplitude = sea["amplitude"][0, 0]
    speed = amplitude * sea["omega"][0, 0]
    assert np.abs(rise[40:]).max() < 0.02 * amplitude
    # Velocities are those of half a substep earlier.
    error = np.abs(np.array(follow) - np.array(water))[40:]
    assert error[:, 2].max() < 0.05 * speed
    assert error[:, :2].max() < 0.1 * speed
    assert np.abs(water)[40:].max() > 0.9 * speed


def runs(substep_s, sea, is_driven, *, num_worlds):
    """Paths ``[T, W, 2]`` of eight seconds of pursuit, or of free drift."""
    worlds = gdrl_tasks.simulate(
        "water",
        num_worlds=num_worlds,
        seed=0,
        sea=sea,
        substep_s=substep_s,
        goal_distance_m=(14.0, 18.0),
    )
    seeds = episode_seeds(Stream.EVALUATION, 9, 0, num_worlds)
    observation = worlds.reset(seeds=seeds)
    path = [worlds.qpos[:, :2].copy()]
    for _ in range(32):
        action = pursuit(observation) if is_driven else np.zeros((num_worlds, 2))
        observation = worlds.step(action).observation
        path.append(worlds.qpos[:, :2].copy())
    return np.array(path)


def substep_error(substep_s, sea, is_driven, *, num_worlds=48):
    """95th percentile over worlds of the largest position error over path length."""
    fine, coarse = (
        runs(length_s, sea, is_driven, num_worlds=num_worlds)
        for length_s in (substep_s / 10.0, substep_s)
    )
    error = np.linalg.norm(coarse - fine, axis=-1).max(axis=0)
    length = np.linalg.norm(np.diff(fine, axis=0), axis=-1).sum(axis=0)
    return np.quantile(error / length, 0.95)


# Eight seconds and no more: in waves motion without a correction is chaotic, two hulls
# that start a hair apart separate by 20 to 30 % a second, whatever the substep.
SUBSTEP_CASES = [(sea, driven) for sea in ("lake", "rough") for driven in (True, False)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sea", "is_driven"),
    [
        pytest.param(*case, marks=[pytest.mark.full] * (case != ("rough", False)))
        for case in SUBSTEP_CASES
    ],
)
def test_the_substep_is_fine_enough(sea, is_driven):
    assert substep_error(WaterOptions().substep_s, sea, is_driven) <= 0.02


@pytest.mark.full
def test_the_next_longer_substep_is_not_fine_enough():
    # The worst of the cases, with enough worlds for a close call.
    assert substep_error(0.25 / 7, "rough", False, num_worlds=256) > 0.02
