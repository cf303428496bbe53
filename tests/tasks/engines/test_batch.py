"""Both routes to a task, and any number of threads, give the same episodes."""

import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import Outcome, StepResult, Stream, episode_seeds
from gdrl_tasks.controllers import pursuit
from tests.marks import full_but

NUM_WORLDS = 56
"""More than 24 per thread, so that two threads really share the forces."""

VARIANTS = {
    "water": {"name": "water"},
    "far in a rough sea with a current": {
        "name": "water",
        "sea": "rough",
        "difficulty": "far",
        "current_m_s": 0.4,
        "reward": "dense",
        "extra_observations": ("velocity", "roll", "time_left"),
        "step_limit": 60,
    },
    "thruster pairs, cut off": {
        "name": "water",
        "sea": "calm",
        "actions": "discrete",
        "dead_zone_compensated": True,
        "at_limit": "truncated",
        "step_limit": 40,
    },
    "indoor": {"name": "indoor", "step_limit": 200},
    "scattered, held and noisy": {
        "name": "indoor",
        "arena": "scatter",
        "actions": "continuous",
        "scan_hold": True,
        "range_noise": True,
        "goal_tolerance_m": 0.05,
        "step_limit": 90,
    },
    "a corridor all round, cut off": {
        "name": "indoor",
        "arena": "corridor",
        "wheel_speed_limit": "burger",
        "num_beams": 36,
        "field_of_view_deg": 360.0,
        "at_limit": "truncated",
        "step_limit": 60,
    },
    "fast": {
        "name": "indoor",
        "arena": "scatter",
        "speed_m_s": 0.2,
        "turn_rates_deg_s": (-60.0, -20.0, 0.0, 20.0, 60.0),
        "step_limit": 60,
    },
}
"""Every option once; they do not depend on each other."""
TWO_OF_A_KIND = [
    {"name": "water"},
    {"name": "indoor"},
    {
        "name": "indoor",
        "arena": "scatter",
        "actions": "continuous",
        "scan_hold": True,
        "range_noise": True,
    },
]
"""A few that stand for all where a behaviour does not depend on the options."""
every_kind = pytest.mark.parametrize(
    "options", TWO_OF_A_KIND, ids=["water", "indoor", "indoor with everything"]
)


def actions_for(task, observation, generator):
    """Half of the worlds pursue their goal, the others do anything."""
    count = len(observation)
    bearing = observation[:, 1]
    if task.spec.is_discrete:
        most = task.spec.action_size - 1
        chosen = generator.integers(most + 1, size=count)
        aim = np.round(0.5 * most + most * bearing).clip(0, most).astype(np.int64)
        return np.where(np.arange(count) % 2 == 0, aim, chosen)
    anything = generator.uniform(-1.2, 1.2, (count, task.spec.action_size))
    aim = pursuit(observation)
    if task.name == "indoor":
        aim = np.stack([np.ones(count), np.clip(4.0 * bearing, -1.0, 1.0)], axis=-1)
    return np.where((np.arange(count) % 2 == 0)[:, None], aim, anything)


def random_actions(task, shape, seed):
    """Actions ``[*shape]`` or ``[*shape, A]`` of a task."""
    generator = np.random.default_rng(seed)
    if task.spec.is_discrete:
        return generator.integers(task.spec.action_size, size=shape)
    return generator.uniform(-1.0, 1.0, (*shape, task.spec.action_size))


def batch_episodes(options, num_threads, seeds):
    """Run whole episodes; actions, and results of all worlds, even of those that ended."""
    worlds = gdrl_tasks.simulate(
        num_worlds=NUM_WORLDS, num_threads=num_threads, seed=0, **options
    )
    generator = np.random.default_rng(0)
    observation = worlds.reset(seeds=seeds)
    first, actions, results = observation, [], []
    size = (NUM_WORLDS,)
    last = [observation, np.zeros(size), *np.zeros((2, *size), bool), np.zeros(size, int)]
    for _ in range(worlds.task.spec.step_limit):
        actions.append(actions_for(worlds.task, last[0], generator))
        running = np.flatnonzero(worlds.arrays["outcome"] == Outcome.RUNNING)
        last = [field.copy() for field in last]
        for field, rows in zip(
            last, worlds.step(actions[-1][running], running), strict=True
        ):
            field[running] = rows
        results.append(StepResult(*last))
    state = worlds.get_state()
    worlds.close()
    return first, actions, results, state


def worlds_to_compare(results):
    """Some of both ends, and two that end in each way that there is."""
    outcomes = np.array([result.outcome for result in results])
    first = outcomes[(outcomes != Outcome.RUNNING).argmax(axis=0), np.arange(NUM_WORLDS)]
    chosen = {0, 1, NUM_WORLDS - 2, NUM_WORLDS - 1}
    for outcome in np.unique(first):
        chosen.update(np.flatnonzero(first == outcome)[:2].tolist())
    return sorted(chosen)


QUICK = ("far in a rough sea with a current", "indoor", "scattered, held and noisy")


@pytest.mark.parametrize("variant", full_but(QUICK, VARIANTS))
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

    environment = gdrl_tasks.load(**options)
    outcomes = set()
    for world in worlds_to_compare(results):
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
        assert step == 1 + next(
            number for number, result in enumerate(results) if result.outcome[world]
        )
    expected = {
        "water": {Outcome.SUCCESS, Outcome.TIMEOUT},
        "indoor": {Outcome.SUCCESS, Outcome.COLLISION, Outcome.TIMEOUT},
    }
    assert outcomes >= expected.get(variant, {Outcome.TIMEOUT})


def flat(time_step):
    return np.concatenate(list(time_step.observation.values()))


@pytest.mark.parametrize(
    ("options", "substep_s"),
    [
        ({"name": "water", "sea": "calm"}, 0.03125),
        ({"name": "water", "sea": "lake"}, 0.03125),
        ({"name": "water", "sea": "rough"}, 0.03125),
        ({"name": "indoor"}, 0.02),
        ({"name": "indoor", "actions": "continuous"}, 0.02),
    ],
    ids=str,
)
def test_the_control_interval_does_not_change_the_motion(options, substep_s):
    seeds = episode_seeds(Stream.EVALUATION, 1, 0, 8)
    ends = []
    for substeps in (1, 5):
        worlds = gdrl_tasks.simulate(
            num_worlds=8,
            num_threads=1,
            seed=0,
            control_interval_s=substeps * substep_s,
            step_limit=1000,
            **options,
        )
        worlds.reset(seeds=seeds)
        # Indoors most of the robots run into something meanwhile.
        action = np.tile([0.9, 0.7], (8, 1))
        if worlds.task.spec.is_discrete:
            action = np.arange(8) % 5
        for _ in range(400 // substeps):
            worlds.step(action)
            worlds.arrays["outcome"][:] = Outcome.RUNNING
        ends.append(np.concatenate([worlds.qpos, worlds.qvel], axis=1))
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-9)
    assert np.abs(ends[0][:, :2]).max() > 0.1


@every_kind
def test_a_restored_state_continues_bit_for_bit(options):
    worlds = gdrl_tasks.simulate(num_worlds=12, num_threads=1, seed=5, **options)
    actions = random_actions(worlds.task, (24, 12), 3)
    worlds.reset()
    # The last scan of a lidar at 5 Hz was one step ago.
    for action in actions[:8]:
        worlds.step(action)
    state = worlds.get_state()

    def continue_run(simulation):
        results = [simulation.step(action) for action in actions[8:]]
        results.append(simulation.reset(np.arange(4)))
        results.append(simulation.step(actions[0]))
        return results, simulation.get_state()

    expected, end = continue_run(worlds)
    # It was in other places, among other obstacles, at another step.
    fresh = gdrl_tasks.simulate(num_worlds=12, num_threads=2, seed=0, **options)
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


def test_a_restored_layout_stops_who_runs_into_it(indoor_at):
    """The engine's walls are those of the state, not those of the last reset."""

    def wall_ahead(shapes, number):
        places = np.tile([100.0, 100.0, 1.0, 0.0], (len(shapes), 1))
        places[0] = 0.5, 0.0, 1.0, 0.0
        return places

    free, blocked = (
        indoor_at([(0.0, 0.0, 0.0)], arena="scatter", layout=layout).get_state()
        for layout in (None, wall_ahead)
    )
    worlds = gdrl_tasks.simulate(
        "indoor", num_worlds=1, seed=0, arena="scatter", step_limit=10**6
    )
    worlds.reset()
    ends = []
    for state in (blocked, free, blocked):
        worlds.set_state(state)
        for _ in range(50):
            worlds.arrays["outcome"][:] = Outcome.RUNNING
            result = worlds.step(np.array([2]))
        ends.append((worlds.qpos[0, 0], result.outcome[0]))
    # Its body ends at the wall's face at 0.45 m; the axle is ahead of its middle.
    assert ends[0] == (pytest.approx(0.45 - 0.11 + 0.032, abs=0.005), Outcome.COLLISION)
    assert ends[1] == (pytest.approx(0.032 + 50 * 0.018, abs=0.02), Outcome.RUNNING)
    assert ends[2] == ends[0]


@every_kind
def test_a_state_is_a_copy(options):
    worlds = gdrl_tasks.simulate(num_worlds=2, num_threads=1, seed=0, **options)
    worlds.reset()
    state = worlds.get_state()
    kept = {name: value.copy() for name, value in state.items()}
    worlds.step(random_actions(worlds.task, (2,), 0))
    for name, value in state.items():
        np.testing.assert_array_equal(value, kept[name])


def assert_rows_equal(one, other, rows):
    """States agree in some worlds, the engine's copy apart: it may lag behind."""
    for name, value in one.items():
        if value.ndim and name != "engine":
            np.testing.assert_array_equal(value[rows], other[name][rows])


@every_kind
@pytest.mark.parametrize("num_threads", [1, 2])
def test_stepping_some_worlds_leaves_the_others_untouched(num_threads, options):
    seeds = episode_seeds(Stream.EVALUATION, 2, 0, 120)
    some, every = (
        gdrl_tasks.simulate(num_worlds=120, num_threads=num_threads, seed=0, **options)
        for _ in range(2)
    )
    some.reset(seeds=seeds), every.reset(seeds=seeds)
    ids = np.flatnonzero(np.arange(120) % 5 < 3)
    others = np.setdiff1d(np.arange(120), ids)
    before = some.get_state()
    action = random_actions(some.task, (6, 120), 0)
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


@every_kind
def test_resetting_some_worlds_leaves_the_others_untouched(options):
    worlds = gdrl_tasks.simulate(num_worlds=6, num_threads=1, seed=0, **options)
    worlds.reset()
    worlds.step(random_actions(worlds.task, (6,), 0))
    before = worlds.get_state()
    worlds.reset(np.array([1, 4]))
    after = worlds.get_state()
    assert_rows_equal(before, after, np.array([0, 2, 3, 5]))
    assert (before["arrays.goal"][[1, 4]] != after["arrays.goal"][[1, 4]]).all()
    assert after["num_episodes_begun"] == before["num_episodes_begun"] + 2


@every_kind
def test_the_same_seed_is_the_same_world_anywhere(options):
    seeds = episode_seeds(Stream.FITNESS, 0, 0, 3)
    worlds = gdrl_tasks.simulate(num_worlds=6, num_threads=1, seed=0, **options)
    worlds.reset(seeds=np.repeat(seeds, 2))
    action = np.repeat(random_actions(worlds.task, (3,), 0), 2, axis=0)
    result = worlds.step(action)
    np.testing.assert_array_equal(result.observation[::2], result.observation[1::2])
    assert len(np.unique(result.observation[:, 0])) == 3
