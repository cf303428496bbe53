"""The compiled loops of a control step against the definition."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gdrl_tasks import kernels
from gdrl_tasks.definition import (
    Outcome,
    decide_outcome,
    goal_polar,
    segment_distance,
    step_reward,
)

TOLERANCE = 1e-12
WORLDS = 5
coordinates = st.floats(-10.0, 10.0, allow_subnormal=False).map(lambda x: round(x, 6))
masks = arrays(bool, WORLDS)


def places(count=WORLDS):
    return arrays(float, (count, 2), elements=coordinates)


@st.composite
def steps_of_worlds(draw):
    """What a control step did to some of the worlds."""
    position = draw(places())
    now = np.where(draw(masks)[:, None], position, draw(places()))
    goal = draw(places())
    # Near goals, and goals on the way, or hardly any episode would succeed.
    fraction = draw(arrays(float, (WORLDS, 1), elements=st.floats(-0.5, 1.5)))
    on_the_way = position + fraction * (now - position)
    near = draw(arrays(float, (WORLDS, 2), elements=st.floats(-0.4, 0.4)))
    goal = np.where(draw(masks)[:, None], on_the_way + near, goal)
    return {
        "ids": np.flatnonzero(draw(masks)),
        "now": now,
        "collided": draw(masks),
        "diverged": draw(masks),
        "capsized": draw(masks),
        "goal": goal,
        "position": position,
        "distance": draw(arrays(float, WORLDS, elements=st.floats(0.0, 10.0))),
        "path_length": draw(arrays(float, WORLDS, elements=st.floats(0.0, 10.0))),
        "episode_return": draw(arrays(float, WORLDS, elements=st.floats(-9.0, 9.0))),
        "steps": draw(arrays(np.int64, WORLDS, elements=st.integers(0, 5))),
        "outcome": np.zeros(WORLDS, dtype=np.int64),
    }


def finish_by_arrays(world, limits):
    """Arrays of all worlds after the step, and the rewards of those that stepped."""
    tolerance, step_limit, weight, truncates = limits
    ids = world["ids"]
    after = {name: value.copy() for name, value in world.items()}
    start, goal = world["position"][ids], world["goal"][ids]
    diverged, collided = world["diverged"][ids], world["collided"][ids]
    end = np.where(diverged[:, None], start, world["now"][ids])
    steps = world["steps"][ids] + 1
    outcome = decide_outcome(
        segment_distance(start, end, goal) <= tolerance,
        collided,
        steps >= step_limit,
        diverged,
        world["capsized"][ids],
    )
    distance, _ = goal_polar(end, np.zeros(len(ids)), goal)
    progress = weight * (world["distance"][ids] - distance)
    reward = step_reward(outcome, progress, truncates)
    after["position"][ids] = end
    after["distance"][ids] = distance
    after["steps"][ids] = steps
    after["outcome"][ids] = outcome
    after["path_length"][ids] += np.linalg.norm(end - start, axis=1)
    after["episode_return"][ids] += reward
    return after, reward


@given(
    world=steps_of_worlds(),
    tolerance=st.floats(0.05, 0.5),
    step_limit=st.integers(1, 6),
    weight=st.sampled_from([0.0, 1.0, 10.0]),
    truncates=st.booleans(),
)
def test_finish_is_the_array_functions_one_after_the_other(
    world, tolerance, step_limit, weight, truncates
):
    start, end, goal = world["position"], world["now"], world["goal"]
    # At the very edge of the goal the last bit decides.
    for reached in (
        segment_distance(start, end, goal),
        segment_distance(start, start, goal),
    ):
        assume((np.abs(reached - tolerance) > 1e-9).all())
    limits = (tolerance, step_limit, weight, truncates)
    expected, expected_reward = finish_by_arrays(world, limits)
    ids = world["ids"]
    names = ["goal", "position", "distance", "path_length", "episode_return"]
    reward = kernels.finish(
        ids,
        world["now"][ids],
        tuple(world[name][ids] for name in ("collided", "diverged", "capsized")),
        limits,
        tuple(world[name] for name in [*names, "steps", "outcome"]),
    )
    np.testing.assert_allclose(reward, expected_reward, rtol=0.0, atol=TOLERANCE)
    for name, value in expected.items():
        np.testing.assert_allclose(world[name], value, rtol=0.0, atol=TOLERANCE)


def test_each_outcome_has_its_reward():
    def one_step(*, now=0.1, steps=0, truncates=False, **happened):
        outcome = np.zeros(1, dtype=np.int64)
        kinds = ("collided", "diverged", "capsized")
        reward = kernels.finish(
            np.zeros(1, dtype=np.int64),
            np.array([[now, 0.0]]),
            tuple(np.array([happened.get(kind, False)]) for kind in kinds),
            (0.2, 10, 10.0, truncates),
            (
                np.array([[1.0, 0.0]]),
                np.zeros((1, 2)),
                np.ones(1),
                np.zeros(1),
                np.zeros(1),
                np.array([steps]),
                outcome,
            ),
        )
        return Outcome(int(outcome[0])), round(float(reward[0]), 9)

    assert one_step() == (Outcome.RUNNING, 1.0)
    assert one_step(now=-0.05) == (Outcome.RUNNING, -0.5)
    assert one_step(now=0.85) == (Outcome.SUCCESS, 1.0)
    assert one_step(now=3.0) == (Outcome.SUCCESS, 1.0)
    assert one_step(collided=True) == (Outcome.COLLISION, -1.0)
    assert one_step(now=0.85, collided=True) == (Outcome.SUCCESS, 1.0)
    assert one_step(steps=9) == (Outcome.TIMEOUT, -1.0)
    assert one_step(steps=9, truncates=True) == (Outcome.TIMEOUT, 1.0)
    assert one_step(steps=9, collided=True, truncates=True) == (Outcome.COLLISION, -1.0)
    assert one_step(now=0.85, diverged=True) == (Outcome.DIVERGED, -1.0)
    assert one_step(now=0.85, capsized=True) == (Outcome.CAPSIZED, -1.0)
    assert one_step(capsized=True, collided=True, steps=9) == (Outcome.CAPSIZED, -1.0)
    assert one_step(capsized=True, diverged=True) == (Outcome.DIVERGED, -1.0)


@given(
    position=places(),
    yaw=arrays(float, WORLDS, elements=st.floats(-20.0, 20.0)),
    goal=places(),
    ids=masks.map(np.flatnonzero),
    scale=st.floats(0.5, 20.0),
)
def test_the_goal_is_observed_in_the_polar_coordinates_of_the_vehicle(
    position, yaw, goal, ids, scale
):
    distance, bearing = goal_polar(position, yaw, goal)
    # Straight behind the last bit decides between left and right.
    assume((np.abs(np.abs(bearing) - np.pi) > 1e-9).all())
    out = np.full((len(ids), 4), 7.0)
    kernels.observe_goal(ids, position[ids], yaw[ids], goal, scale, out)
    expected = np.stack([distance / scale, bearing / np.pi], axis=-1)[ids]
    np.testing.assert_allclose(out[:, :2], expected, rtol=0.0, atol=TOLERANCE)
    np.testing.assert_array_equal(out[:, 2:], 7.0)
    # And once more from first principles: walk that far in that direction.
    heading = yaw[ids] + np.pi * out[:, 1]
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    there = position[ids] + scale * out[:, :1] * ahead
    np.testing.assert_allclose(there, goal[ids], rtol=0.0, atol=1e-10)


@given(quaternion=arrays(float, (WORLDS, 4), elements=st.floats(-1.0, 1.0)))
def test_a_heading_is_where_the_body_looks(quaternion):
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    assume((length > 0.1).all())
    w, x, y, z = (quaternion / length).T
    # The body's x axis, turned by the quaternion.
    ahead = np.stack([w * w + x * x - y * y - z * z, 2.0 * (w * z + x * y)], axis=-1)
    assume((np.linalg.norm(ahead, axis=1) > 1e-3).all())
    qpos = np.zeros((WORLDS, 9))
    qpos[:, :2] = [3.0, -4.0]
    qpos[:, 3:7] = quaternion / length
    position, yaw = kernels.free_body_pose(qpos)
    np.testing.assert_array_equal(position, qpos[:, :2])
    seen = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    expected = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    np.testing.assert_allclose(seen, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e6, -1e7])
@pytest.mark.parametrize("velocity", [False, True])
def test_a_state_with_one_bad_number_is_not_sane(bad, velocity):
    qpos, qvel = np.zeros((6, 9)), np.zeros((6, 8))
    qpos[:], qvel[:] = 9e5, -9e5
    some = np.array([0, 1, 4, 5])
    assert kernels.rows_are_sane(some, qpos, qvel).all()
    assert kernels.all_sane(qpos, qvel)
    assert kernels.all_sane(qpos[0], qvel[0])
    for world, column in ((0, 0), (2, 5), (5, 7)):
        (qvel if velocity else qpos)[world, column] = bad
    assert kernels.rows_are_sane(some, qpos, qvel).tolist() == [False, True, True, False]
    sane = kernels.rows_are_sane(np.arange(6), qpos, qvel)
    assert sane.tolist() == [False, True, False, True, True, False]
    assert not kernels.all_sane(qpos, qvel)
    for world, is_sane in enumerate(sane):
        assert kernels.all_sane(qpos[world], qvel[world]) == is_sane


@given(ids=st.lists(st.integers(-2, 6), min_size=1, max_size=5))
def test_rows_are_ascending_and_in_range(ids):
    expected = ids == sorted(set(ids)) and set(ids) <= set(range(5))
    assert kernels.are_rows(np.array(ids), 5) == expected


def test_a_warning_counts_once_for_the_worlds_asked_about_and_for_kinds_that_count():
    warnings, known = np.zeros((4, 8, 2), dtype=np.int32), np.zeros(4, dtype=np.int64)
    kinds, some = np.array([2, 5]), np.array([0, 1, 3])
    warnings[1, 5, 1], warnings[2, 5, 1], warnings[3, 4, 1] = 1, 1, 1
    warnings[0, 2, 0] = 1  # where it was, not how often

    def ask():
        return kernels.newly_warned(some, warnings, kinds, known).tolist()

    assert ask() == [False, True, False]
    assert ask() == [False, False, False]
    warnings[1, 5, 1] += 1
    warnings[0, 2, 1] += 3
    assert ask() == [True, True, False]
    assert known.tolist() == [3, 2, 0, 0]


@given(values=arrays(float, (WORLDS, 3), elements=st.floats(allow_nan=False)))
def test_rows_are_clipped_as_numpy_clips(values):
    low, high = np.array([-1.0, 0.0, 2.0]), np.array([1.0, 0.5, 3.0])
    expected = np.clip(values, low, high)
    kernels.clip_rows(values, low, high)
    np.testing.assert_array_equal(values, expected)
