"""Both routes to a task, and any number of threads, give the same episodes."""

import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import Outcome, Stream, episode_seeds
from gdrl_tasks.controllers import pursuit

NUM_WORLDS = 56
"""More than 24 per thread, so that two threads really share the forces."""

VARIANTS = {
    "default": {},
    "calm": {"sea": "calm", "step_limit": 60},
    "rough": {"sea": "rough", "step_limit": 60},
    "far": {"difficulty": "far", "step_limit": 80},
    "discrete": {"actions": "discrete", "step_limit": 60},
    "dense": {"reward": "dense", "step_limit": 60},
    "truncated": {"at_limit": "truncated", "step_limit": 40},
    "current": {"current_m_s": 0.4, "step_limit": 60},
    "extras": {"extra_observations": ("velocity", "roll", "time_left"), "step_limit": 60},
    "compensated": {"dead_zone_compensated": True, "step_limit": 60},
}


def actions_for(task, observation, generator):
    """Half of the worlds pursue their goal, the others do anything."""
    count = len(observation)
    if task.spec.is_discrete:
        chosen = generator.integers(task.spec.action_size, size=count)
        aim = np.round(3.0 + 6.0 * observation[:, 1]).clip(0, 6).astype(np.int64)
        return np.where(np.arange(count) % 2 == 0, aim, chosen)
    anything = generator.uniform(-1.2, 1.2, (count, task.spec.action_size))
    return np.where((np.arange(count) % 2 == 0)[:, None], pursuit(observation), anything)


def batch_episodes(options, num_threads, seeds):
    """Run whole episodes, every world to the step limit; actions and results."""
    worlds = gdrl_tasks.simulate(
        "water", num_worlds=NUM_WORLDS, num_threads=num_threads, **options
    )
    generator = np.random.default_rng(0)
    observation = worlds.reset(seeds=seeds)
    first, actions, results = observation, [], []
    for _ in range(worlds.task.spec.step_limit):
        actions.append(actions_for(worlds.task, observation, generator))
        results.append(worlds.step(actions[-1]))
        observation = results[-1].observation
    state = worlds.get_state()
    worlds.close()
    return first, actions, results, state


@pytest.mark.parametrize("variant", VARIANTS)
def test_routes_and_thread_counts_agree_over_whole_episodes(variant):
    options = VARIANTS[variant]
    seeds = episode_seeds(Stream.EVALUATION, 0, 0, NUM_WORLDS)
    first, actions, results, state = batch_episodes(options, 1, seeds)
    _, _, threaded, threaded_state = batch_episodes(options, 2, seeds)
    for one, two in zip(results, threaded, strict=True):
        for field, other in zip(one, two, strict=True):
            np.testing.assert_array_equal(field, other)
    for name, value in state.items():
        np.testing.assert_array_equal(value, threaded_state[name])

    environment = gdrl_tasks.load("water", **options)
    outcomes = set()
    for world in (0, 1, 2, 3, NUM_WORLDS - 2, NUM_WORLDS - 1):
        environment.task.next_episode_seed = int(seeds[world])
        time_step = environment.reset()
        assert flat(time_step) == pytest.approx(first[world], abs=1e-9)
        step = 0
        while not time_step.last():
            time_step = environment.step(actions[step][world])
            result = results[step]
            assert flat(time_step) == pytest.approx(result.observation[world], abs=1e-9)
            assert time_step.reward == pytest.approx(result.reward[world], abs=1e-9)
            ended = result.terminated[world] or result.truncated[world]
            assert time_step.last() == ended
            assert time_step.discount == (0.0 if result.terminated[world] else 1.0)
            assert environment.task.outcome == result.outcome[world]
            step += 1
        outcomes.add(environment.task.outcome)
        assert environment.task.arrays["episode_seed"][0] == seeds[world]
    assert Outcome.TIMEOUT in outcomes
    if variant == "default":
        assert Outcome.SUCCESS in outcomes


def flat(time_step):
    return np.concatenate(list(time_step.observation.values()))


@pytest.mark.parametrize("sea", ["calm", "lake", "rough"])
def test_the_control_interval_does_not_change_a_free_drift(sea):
    seeds = episode_seeds(Stream.EVALUATION, 1, 0, 8)
    ends = []
    for substeps in (1, 5):
        worlds = gdrl_tasks.simulate(
            "water",
            num_worlds=8,
            num_threads=1,
            sea=sea,
            control_interval_s=substeps * 0.03125,
            step_limit=1000,
        )
        worlds.reset(seeds=seeds)
        for _ in range(400 // substeps):
            worlds.step(np.zeros((8, 2)))
        ends.append(np.concatenate([worlds.qpos, worlds.qvel], axis=1))
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-9)


def test_a_restored_state_continues_bit_for_bit():
    generator = np.random.default_rng(3)
    actions = generator.uniform(-1.0, 1.0, (16, 12, 2))
    worlds = gdrl_tasks.simulate("water", num_worlds=12, num_threads=1, seed=5)
    worlds.reset()
    for action in actions[:8]:
        worlds.step(action)
    state = worlds.get_state()

    def continue_run(simulation):
        results = [simulation.step(action) for action in actions[8:]]
        results.append(simulation.reset(np.arange(4)))
        results.append(simulation.step(actions[0]))
        return results, simulation.get_state()

    expected, end = continue_run(worlds)
    fresh = gdrl_tasks.simulate("water", num_worlds=12, num_threads=2, seed=0)
    fresh.reset()
    fresh.step(actions[0])
    for simulation in (fresh, worlds):
        simulation.set_state(state)
        results, other_end = continue_run(simulation)
        for one, other in zip(expected, results, strict=True):
            for field, value in zip(one, other, strict=True):
                np.testing.assert_array_equal(field, value)
        for name, value in end.items():
            np.testing.assert_array_equal(value, other_end[name])


def test_a_state_is_a_copy():
    worlds = gdrl_tasks.simulate("water", num_worlds=2, num_threads=1)
    worlds.reset()
    state = worlds.get_state()
    kept = {name: value.copy() for name, value in state.items()}
    worlds.step(np.ones((2, 2)))
    for name, value in state.items():
        np.testing.assert_array_equal(value, kept[name])


def assert_rows_equal(one, other, rows):
    """States agree in some worlds, the engine's copy apart: it may lag behind."""
    for name, value in one.items():
        if value.ndim and name != "engine":
            np.testing.assert_array_equal(value[rows], other[name][rows])


@pytest.mark.parametrize("num_threads", [1, 2])
def test_stepping_some_worlds_leaves_the_others_untouched(num_threads):
    seeds = episode_seeds(Stream.EVALUATION, 2, 0, 120)
    some, every = (
        gdrl_tasks.simulate("water", num_worlds=120, num_threads=num_threads)
        for _ in range(2)
    )
    some.reset(seeds=seeds), every.reset(seeds=seeds)
    ids = np.flatnonzero(np.arange(120) % 5 < 3)
    others = np.setdiff1d(np.arange(120), ids)
    before = some.get_state()
    action = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 120, 2))
    whole = [every.step(action[step]) for step in range(6)]
    for step in range(6):
        result = some.step(action[step, ids], ids)
        for field, value in zip(result, whole[step], strict=True):
            np.testing.assert_array_equal(field, value[ids])
    assert_rows_equal(some.get_state(), before, others)
    # The others can still go on from where they were.
    for step in range(6):
        result = some.step(action[step, others], others)
        for field, value in zip(result, whole[step], strict=True):
            np.testing.assert_array_equal(field, value[others])
    assert_rows_equal(some.get_state(), every.get_state(), np.arange(120))


def test_resetting_some_worlds_leaves_the_others_untouched():
    worlds = gdrl_tasks.simulate("water", num_worlds=6, num_threads=1)
    worlds.reset()
    worlds.step(np.ones((6, 2)))
    before = worlds.get_state()
    worlds.reset(np.array([1, 4]))
    after = worlds.get_state()
    assert_rows_equal(before, after, np.array([0, 2, 3, 5]))
    assert (before["arrays.goal"][[1, 4]] != after["arrays.goal"][[1, 4]]).all()
    assert after["num_episodes_begun"] == before["num_episodes_begun"] + 2


def test_the_same_seed_is_the_same_world_anywhere():
    seeds = episode_seeds(Stream.FITNESS, 0, 0, 3)
    worlds = gdrl_tasks.simulate("water", num_worlds=6, num_threads=1)
    worlds.reset(seeds=np.repeat(seeds, 2))
    result = worlds.step(np.ones((6, 2)))
    np.testing.assert_array_equal(result.observation[::2], result.observation[1::2])
    assert len(np.unique(result.observation[:, 0])) == 3
