"""A planner may copy, pickle and rewind dm_control's physics: all go on bit for bit."""

import copy
import pickle

import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import Outcome

VARIANTS = {
    "water": {"name": "water", "current_m_s": 0.4, "reward": "dense"},
    "indoor": {"name": "indoor"},
    "indoor with everything": {
        "name": "indoor",
        "arena": "scatter",
        "actions": "continuous",
        "scan_hold": True,
        "range_noise": True,
    },
}
every_variant = pytest.mark.parametrize("options", VARIANTS.values(), ids=list(VARIANTS))


def load(options, **kwargs):
    return gdrl_tasks.load(**options | {"random": 3} | kwargs)


def actions_of(environment, count, seed=0):
    generator = np.random.default_rng(seed)
    task = environment.task.task
    if task.spec.is_discrete:
        return generator.integers(task.spec.action_size, size=count)
    return generator.uniform(-1.0, 1.0, (count, task.spec.action_size))


def seen(environment, time_step):
    """All that a step shows, as one vector."""
    values = [np.ravel(value) for value in time_step.observation.values()]
    numbers = (time_step.reward, time_step.discount, environment.physics.time())
    numbers = [np.nan if number is None else number for number in numbers]
    physics = environment.physics.data.qpos, environment.physics.data.qvel
    return np.concatenate([*values, numbers, *physics])


def roll(environment, actions):
    return np.array([seen(environment, environment.step(action)) for action in actions])


def uninterrupted(options, num_before, num_after):
    """The rows after some steps of an environment that nobody has touched, and actions."""
    environment = load(options)
    environment.reset()
    actions = actions_of(environment, num_before + num_after)
    return roll(environment, actions)[num_before:], actions


def roll_by_task(task, physics, actions, num_substeps):
    """The same rows from a physics of one's own, by the methods of a suite's task."""
    rows = []
    for action in actions:
        task.before_step(action, physics)
        physics.step(num_substeps)
        task.after_step(physics)
        observation = [np.ravel(v) for v in task.get_observation(physics).values()]
        discount = task.get_termination(physics)
        discount = 1.0 if discount is None else discount
        numbers = [task.get_reward(physics), discount, physics.time()]
        state = physics.data.qpos, physics.data.qvel
        rows.append(np.concatenate([*observation, numbers, *state]))
    return np.array(rows)


@every_variant
def test_a_rewound_episode_goes_on_bit_for_bit(options):
    expected, actions = uninterrupted(options, 7, 9)
    environment = load(options)
    environment.reset()
    roll(environment, actions[:7])
    state = environment.physics.get_state()
    kept = state.copy()
    for plan in range(3):
        roll(environment, actions_of(environment, 6, seed=1 + plan))
        environment.physics.set_state(state)
        np.testing.assert_array_equal(environment.physics.get_state(), kept)
    np.testing.assert_array_equal(roll(environment, actions[7:]), expected)
    np.testing.assert_array_equal(state, kept)


@every_variant
def test_an_episode_can_be_gone_back_to_after_its_end_and_from_another_one(options):
    options = options | {"step_limit": 16}
    expected, actions = uninterrupted(options, 7, 9)
    environment = load(options)
    environment.reset()
    roll(environment, actions[:7])
    state = environment.physics.get_state()
    seed = environment.task.arrays["episode_seed"][0]
    # To its end: stepping on would begin a new episode.
    roll(environment, actions[7:])
    assert environment.task.outcome != Outcome.RUNNING
    environment.physics.set_state(state)
    np.testing.assert_array_equal(roll(environment, actions[7:]), expected)
    # In another episode, with other obstacles and another sea.
    environment.reset()
    roll(environment, actions[:5])
    assert environment.task.arrays["episode_seed"][0] != seed
    environment.physics.set_state(state)
    assert environment.task.arrays["episode_seed"][0] == seed
    np.testing.assert_array_equal(roll(environment, actions[7:]), expected)
    assert environment.step(actions[0]).first()


@every_variant
def test_a_state_can_be_set_within_a_reset_context(options):
    expected, actions = uninterrupted(options, 7, 9)
    environment = load(options)
    environment.reset()
    roll(environment, actions[:7])
    state = environment.physics.get_state()
    roll(environment, actions[::-1][:4])
    with environment.physics.reset_context():
        environment.physics.set_state(state)
    np.testing.assert_array_equal(roll(environment, actions[7:]), expected)


@every_variant
@pytest.mark.parametrize("way", ["copy", "pickle", "deepcopy"])
def test_a_copied_physics_goes_on_bit_for_bit_and_alone(way, options):
    expected, actions = uninterrupted(options, 7, 9)
    environment = load(options)
    environment.reset()
    roll(environment, actions[:7])
    original = environment.physics
    before = original.get_state()
    ways = {
        "copy": original.copy,
        "pickle": lambda: pickle.loads(pickle.dumps(original)),
        "deepcopy": lambda: copy.deepcopy(original),
    }
    other = ways[way]()
    np.testing.assert_array_equal(other.get_state(), before)
    substeps = environment.task.task.spec.num_substeps
    rows = roll_by_task(environment.task, other, actions[7:], substeps)
    np.testing.assert_array_equal(rows, expected)
    np.testing.assert_array_equal(original.get_state(), before)
    np.testing.assert_array_equal(roll(environment, actions[7:]), expected)


@every_variant
@pytest.mark.parametrize("way", ["deepcopy", "pickle"])
def test_a_copied_environment_goes_on_bit_for_bit_and_alone(way, options):
    expected, actions = uninterrupted(options, 7, 9)
    environment = load(options)
    environment.reset()
    roll(environment, actions[:7])
    ways = {"deepcopy": copy.deepcopy, "pickle": lambda x: pickle.loads(pickle.dumps(x))}
    other = ways[way](environment)
    np.testing.assert_array_equal(roll(other, actions[7:]), expected)
    np.testing.assert_array_equal(roll(environment, actions[7:]), expected)
    # Both draw the same next episode.
    mine, others = environment.reset().observation, other.reset().observation
    for key, value in mine.items():
        np.testing.assert_array_equal(value, others[key])


@pytest.mark.parametrize("share_model", [False, True])
def test_the_copy_of_a_vessel_floats_as_the_vessel_does(share_model):
    environment = load({"name": "water", "sea": "rough"})
    environment.reset()
    physics = environment.physics
    other = physics.copy(share_model=share_model)
    loaded = pickle.loads(pickle.dumps(physics))
    for each in (physics, other, loaded):
        each.step(64)  # two seconds
        assert abs(each.data.qpos[2]) < 0.5
        np.testing.assert_array_equal(each.data.qpos, physics.data.qpos)
    physics.step()
    assert (physics.data.qpos != other.data.qpos).any()


def test_a_state_keeps_what_does_not_fit_into_a_float():
    environment = load({"name": "indoor"})
    largest = 2**63 - 1
    environment.task.next_episode_seed = largest
    environment.reset()
    state = environment.physics.get_state()
    assert np.isfinite(state).all()
    environment.reset()
    environment.physics.set_state(state)
    assert int(environment.task.arrays["episode_seed"][0]) == largest


def test_a_diverged_world_is_healthy_again_after_it_was_set_back():
    expected, actions = uninterrupted({"name": "water"}, 3, 4)
    environment = load({"name": "water"})
    environment.reset()
    roll(environment, actions[:3])
    state = environment.physics.get_state()
    environment.physics.data.qvel[:] = np.nan
    assert environment.step(actions[0]).last()
    assert environment.task.outcome == Outcome.DIVERGED
    end = environment.physics.get_state()
    environment.physics.set_state(state)
    np.testing.assert_array_equal(roll(environment, actions[3:]), expected)
    environment.physics.set_state(end)
    assert environment.task.outcome == Outcome.DIVERGED
    np.testing.assert_array_equal(environment.physics.get_state(), end)


def test_a_state_of_another_task_is_refused():
    water, indoor = load({"name": "water"}), load({"name": "indoor"})
    with pytest.raises(ValueError, match=r"physics_state of shape .* must have shape"):
        water.physics.set_state(indoor.physics.get_state())


def test_a_physics_whose_episode_has_not_begun_or_has_ended_is_not_stepped_by_the_task():
    environment = load({"name": "water", "step_limit": 2})
    with pytest.raises(RuntimeError, match="none has begun"):
        environment.task.before_step(np.zeros(2), environment.physics)
    with pytest.raises(RuntimeError, match="no episode has begun: reset"):
        _ = environment.task.outcome
    # The environment begins one by itself, as dm_control's do.
    assert environment.step(np.zeros(2)).first()
    environment.step(np.zeros(2))
    assert environment.step(np.zeros(2)).last()
    with pytest.raises(RuntimeError, match="it ended: TIMEOUT"):
        environment.task.before_step(np.zeros(2), environment.physics)
    assert environment.step(np.zeros(2)).first()


@every_variant
def test_the_two_ways_to_step_of_dm_control_give_the_same_motion(options):
    legacy, plain = (
        load(options, environment_kwargs={"legacy_step": legacy})
        for legacy in (True, False)
    )
    actions = actions_of(legacy, 12)
    legacy.reset(), plain.reset()
    np.testing.assert_allclose(roll(plain, actions), roll(legacy, actions), atol=1e-9)
    other = plain.physics.copy()
    assert other.legacy_step is False
