"""The robot drives as it is told: speed, turn rate, the limit of its wheels."""

import itertools

import numpy as np
import pytest

TICK_S = 0.02
TURN_RATES_DEG_S = np.array([-90.0, -45.0, 0.0, 45.0, 90.0])
WHEEL_SEPARATION_M = 0.160
BURGER_RIM_M_S = 0.227
RESPONSE_S = 0.5
"""After this the robot moves as commanded."""


def motion(states, indoor_pose):
    """Speeds of the axle's middle, m/s, and turn rates, rad/s, ``[T - 1, W]`` each."""
    states = np.array(states)
    _, heading = indoor_pose(states)
    way = np.hypot(*np.moveaxis(np.diff(states[..., :2], axis=0), -1, 0))
    turn = np.diff(np.unwrap(heading, axis=0), axis=0)
    return way / TICK_S, turn / TICK_S


def drive(worlds, action, time_s):
    """States before and after every tick of a constant action, ``[T + 1, W, nq]``."""
    states = [worlds.qpos.copy()]
    for _ in range(round(time_s / TICK_S)):
        worlds.step(action)
        states.append(worlds.qpos.copy())
    return states


def assert_follows(states, speed, turn, indoor_pose):
    """Half a second after a change every tick is within 3 % of the command.

    Or within 1.5 mm/s: the tyres creep by a millimetre a second as the robot turns.
    """
    settled = states[round(RESPONSE_S / TICK_S) :]
    speeds, turns = motion(settled, indoor_pose)
    assert len(speeds) >= 25
    assert (np.abs(speeds - speed) <= np.maximum(0.03 * speed, 1.5e-3)).all()
    assert (np.abs(turns - turn) <= 0.03 * np.abs(turn) + 1e-4).all()


@pytest.mark.parametrize("speed", [0.10, 0.15, 0.20])
def test_every_change_between_discrete_actions_is_followed(speed, indoor_at, indoor_pose):
    changes = np.array(list(itertools.product(range(5), range(5))))
    worlds = indoor_at(np.zeros((25, 3)), speed_m_s=speed, control_interval_s=TICK_S)
    for action in changes.T:
        states = drive(worlds, action, 1.2)
        turn = np.radians(TURN_RATES_DEG_S[action])
        assert_follows(states, np.full(25, speed), turn, indoor_pose)


@pytest.mark.parametrize("speed", [0.10, 0.15, 0.20])
def test_continuous_commands_are_followed(speed, indoor_at, indoor_pose):
    commands = np.array(
        [
            (1.0, 0.0),
            (0.0, 0.3),
            (-0.5, -1.0),
            (0.7, 1.0),
            (-1.0, 1.0),
            (-1.0, -0.25),
            (-1.0, 0.0),
            (0.33, -0.61),
        ]
    )
    options = {"actions": "continuous", "speed_m_s": speed, "control_interval_s": TICK_S}
    worlds = indoor_at(np.zeros((len(commands), 3)), **options)
    for order in (slice(None), slice(None, None, -1)):
        action = commands[order]
        states = drive(worlds, action, 1.2)
        ahead = 0.5 * (1.0 + action[:, 0]) * speed
        turn = np.radians(90.0) * action[:, 1]
        assert_follows(states, ahead, turn, indoor_pose)


def test_tyres_hold_when_the_turn_changes(indoor_at, indoor_pose):
    changes = np.array(list(itertools.product(range(5), range(5))))
    worlds = indoor_at(np.zeros((25, 3)), control_interval_s=TICK_S)
    drive(worlds, changes[:, 0], 1.0)
    speeds, _ = motion(drive(worlds, changes[:, 1], 0.3), indoor_pose)
    # A tyre that slips lets the robot lose its speed, up to a third of it.
    assert (speeds > 0.95 * 0.15).all()


def test_own_turn_rates_are_followed(indoor_at, indoor_pose):
    rates = (-120.0, 10.0, 60.0)
    worlds = indoor_at(np.zeros((3, 3)), turn_rates_deg_s=rates, control_interval_s=TICK_S)
    states = drive(worlds, np.arange(3), 1.2)
    assert_follows(states, np.full(3, 0.15), np.radians(rates), indoor_pose)


def test_continuous_commands_beyond_their_bounds_are_those_at_the_bounds(indoor_at):
    bold, bounded = (indoor_at(np.zeros((2, 3)), actions="continuous") for _ in range(2))
    for _ in range(5):
        bold.step(np.array([[1.7, -2.0], [-3.0, 1.1]]))
        bounded.step(np.array([[1.0, -1.0], [-1.0, 1.0]]))
    np.testing.assert_array_equal(bold.qpos, bounded.qpos)


def test_the_burgers_wheels_are_slowed_together(indoor_at, indoor_pose):
    options = {"wheel_speed_limit": "burger", "control_interval_s": TICK_S}
    worlds = indoor_at(np.zeros((5, 3)), **options)
    states = drive(worlds, np.arange(5), 2.0)
    turn = np.radians(TURN_RATES_DEG_S)
    fastest = 0.15 + 0.5 * WHEEL_SEPARATION_M * np.abs(turn)
    factor = np.minimum(1.0, BURGER_RIM_M_S / fastest)
    assert factor[[0, 4]] == pytest.approx(0.8235, abs=1e-4)
    assert factor[[1, 2, 3]].tolist() == [1.0, 1.0, 1.0]
    assert_follows(states, factor * 0.15, factor * turn, indoor_pose)
    speeds, turns = motion(states[25:], indoor_pose)
    rims = speeds + 0.5 * WHEEL_SEPARATION_M * np.abs(turns)
    assert rims.max() <= 1.01 * BURGER_RIM_M_S
    # Slower, but on the same circle as without the limit.
    unlimited = indoor_at(np.zeros((5, 3)), control_interval_s=TICK_S)
    free_speeds, free_turns = motion(drive(unlimited, np.arange(5), 2.0)[25:], indoor_pose)
    radius, free_radius = (speeds / turns)[:, [0, 4]], (free_speeds / free_turns)[:, [0, 4]]
    assert radius == pytest.approx(free_radius, rel=0.01)
    assert np.abs(free_radius) == pytest.approx(0.15 / np.radians(90.0), rel=0.03)


def test_the_burgers_limit_changes_nothing_below_it(indoor_at):
    free, limited = (
        indoor_at(np.zeros((3, 3)), wheel_speed_limit=limit) for limit in (None, "burger")
    )
    for _ in range(10):
        free.step(np.array([1, 2, 3])), limited.step(np.array([1, 2, 3]))
    np.testing.assert_array_equal(free.qpos, limited.qpos)


def test_a_straight_drive_stays_straight(indoor_at, indoor_pose):
    headings = np.linspace(-np.pi, np.pi, 9)
    poses = np.stack([np.zeros(9), np.zeros(9), headings], axis=-1)
    worlds = indoor_at(poses)
    start, _ = indoor_pose(worlds.qpos)
    for _ in range(170):
        worlds.step(np.full(9, 2))
    end, heading = indoor_pose(worlds.qpos)
    way = end - start
    ahead = np.cos(headings) * way[:, 0] + np.sin(headings) * way[:, 1]
    aside = np.cos(headings) * way[:, 1] - np.sin(headings) * way[:, 0]
    assert ahead == pytest.approx(170 * 0.12 * 0.15, rel=0.03)
    assert np.abs(aside).max() < 1e-3 * ahead.min()
    turned = np.angle(np.exp(1j * (heading - headings)))
    assert np.abs(turned).max() < np.radians(0.1)


def test_left_and_right_are_mirror_images(indoor_at, indoor_pose):
    worlds = indoor_at(np.zeros((2, 3)))
    generator = np.random.default_rng(0)
    for _ in range(40):
        choice = generator.integers(5)
        worlds.step(np.array([choice, 4 - choice]))
    middle, heading = indoor_pose(worlds.qpos)
    assert middle[1] == pytest.approx(middle[0] * [1.0, -1.0], abs=1e-6)
    assert heading[1] == pytest.approx(-heading[0], abs=1e-6)
    assert np.hypot(*middle[0]) > 0.2


def test_a_change_of_speed_takes_some_hundredths_of_a_second(indoor_at, indoor_pose):
    options = {"actions": "continuous", "control_interval_s": TICK_S}
    worlds = indoor_at(np.zeros((1, 3)), **options)
    states = drive(worlds, np.array([[1.0, 0.0]]), 1.0)
    speeds, _ = motion(states, indoor_pose)
    share = speeds[:, 0] / speeds[-1, 0]
    assert np.flatnonzero(share > 0.63)[0] * TICK_S == pytest.approx(0.04, abs=0.021)
    assert (share[round(0.3 / TICK_S) :] > 0.98).all()


def test_the_robot_stands_where_it_starts(indoor_at, indoor_pose):
    options = {"actions": "continuous", "arena": "scatter"}
    worlds = indoor_at([(0.4, -0.3, 1.0), (-1.0, 2.0, -2.0)], **options)
    start, heading = indoor_pose(worlds.qpos)
    for _ in range(100):
        worlds.step(np.tile([-1.0, 0.0], (2, 1)))
    end, after = indoor_pose(worlds.qpos)
    np.testing.assert_allclose(end, start, atol=1e-4)
    np.testing.assert_allclose(after, heading, atol=1e-3)
