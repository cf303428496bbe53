"""A world that diverges ends its episode, says nothing and harms no other world."""

import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import Outcome
from gdrl_tasks.engines.replay import repeat_step

NUM_WORLDS = 60

pytestmark = pytest.mark.filterwarnings("error")


def break_position(qpos, qvel):
    qpos[0] = np.nan


def break_height(qpos, qvel):
    qpos[2] = 1e12


def break_attitude(qpos, qvel):
    qpos[3:] = np.inf


def break_last_joint(qpos, qvel):
    qpos[-1] = np.nan


def break_velocity(qpos, qvel):
    qvel[1] = -np.inf


def spin_out_of_control(qpos, qvel):
    # Still a state to be believed: the engine itself finds the acceleration bad.
    qvel[3:] = 9e5


INJURIES = [
    break_position,
    break_height,
    break_attitude,
    break_last_joint,
    break_velocity,
    spin_out_of_control,
]
every_injury = pytest.mark.parametrize("injure", INJURIES, ids=lambda f: f.__name__)
# One that the state shows, and one that only the engine finds.
both_kinds = pytest.mark.parametrize(
    "injure", [break_position, spin_out_of_control], ids=lambda f: f.__name__
)
every_task = pytest.mark.parametrize("name", ["water", "indoor"])


@pytest.fixture
def silence(tmp_path, monkeypatch, capfd):
    """Run in an empty folder; in the end nothing was printed or written there."""
    monkeypatch.chdir(tmp_path)
    yield
    printed = capfd.readouterr()
    assert printed.out == ""
    assert printed.err == ""
    assert list(tmp_path.iterdir()) == []


def started(name, num_threads=1, **options):
    worlds = gdrl_tasks.simulate(
        name, num_worlds=NUM_WORLDS, num_threads=num_threads, seed=0, **options
    )
    worlds.reset()
    return worlds


def random_actions(task, shape, seed=0):
    """Actions ``[*shape]`` or ``[*shape, A]`` of a task."""
    generator = np.random.default_rng(seed)
    if task.spec.is_discrete:
        return generator.integers(task.spec.action_size, size=shape)
    return generator.uniform(-1.0, 1.0, (*shape, task.spec.action_size))


def assert_others_untouched(worlds, healthy, others):
    for name, value in healthy.get_state().items():
        if value.ndim:
            np.testing.assert_array_equal(worlds.get_state()[name][others], value[others])


@every_task
@every_injury
def test_a_world_with_a_bad_state_diverges_alone(injure, name, silence):
    worlds, healthy = started(name, num_threads=2), started(name, num_threads=2)
    actions = random_actions(worlds.task, (4, NUM_WORLDS))
    others = np.delete(np.arange(NUM_WORLDS), 7)
    worlds.step(actions[0])
    healthy.step(actions[0])
    injure(worlds.qpos[7], worlds.qvel[7])
    result = worlds.step(actions[1])
    expected = healthy.step(actions[1])
    assert result.outcome[7] == Outcome.DIVERGED
    assert result.reward[7] == -1.0
    assert result.terminated[7]
    assert not result.truncated[7]
    low, high = worlds.task.spec.observation_bounds
    assert ((low <= result.observation) & (result.observation <= high)).all()
    for field, value in zip(result, expected, strict=True):
        np.testing.assert_array_equal(field[others], value[others])
    for action in actions[2:]:
        worlds.step(action[others], others)
        healthy.step(action[others], others)
    assert_others_untouched(worlds, healthy, others)
    assert np.isfinite(worlds.arrays["path_length"]).all()
    assert np.isfinite(worlds.arrays["episode_return"]).all()


@every_task
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_a_world_whose_action_is_not_finite_diverges_alone(value, name, silence):
    worlds, healthy = (started(name, actions="continuous") for _ in range(2))
    action = np.full((NUM_WORLDS, 2), 0.8)
    expected = healthy.step(action)
    action[7, 1] = value
    result = worlds.step(action)
    others = np.delete(np.arange(NUM_WORLDS), 7)
    assert result.outcome[7] == Outcome.DIVERGED
    assert result.reward[7] == -1.0
    assert np.isfinite(result.observation).all()
    np.testing.assert_array_equal(result.observation[others], expected.observation[others])
    assert_others_untouched(worlds, healthy, others)


@every_task
def test_a_discrete_action_that_is_not_a_number_diverges(name, silence):
    worlds = started(name, actions="discrete")
    action = np.zeros(NUM_WORLDS)
    action[3] = np.nan
    outcome = worlds.step(action).outcome
    assert outcome[3] == Outcome.DIVERGED
    assert (np.delete(outcome, 3) == Outcome.RUNNING).all()


@every_task
@both_kinds
def test_a_diverged_world_stays_diverged_until_its_reset(injure, name, silence):
    worlds = started(name)
    action = random_actions(worlds.task, (NUM_WORLDS,))
    injure(worlds.qpos[7], worlds.qvel[7])
    result = worlds.step(action)
    assert result.outcome[7] == Outcome.DIVERGED
    assert np.isfinite(result.observation).all()
    others = np.delete(np.arange(NUM_WORLDS), 7)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="world 7: it ended: DIVERGED"):
            worlds.step(action)
        worlds.step(action[others], others)
        assert worlds.arrays["outcome"][7] == Outcome.DIVERGED
        assert np.isfinite(worlds.observe()).all()
    seed = np.array([123])
    observation = worlds.reset(np.array([7]), seed)
    fresh = gdrl_tasks.simulate(name, num_worlds=1, num_threads=1, seed=0)
    np.testing.assert_array_equal(observation, fresh.reset(seeds=seed))
    for _ in range(5):
        result = worlds.step(action[:1], np.array([7]))
        expected = fresh.step(action[:1])
        for field, value in zip(result, expected, strict=True):
            np.testing.assert_array_equal(field, value)


@every_task
def test_divergence_hides_a_truncation(name, silence):
    worlds = started(name, at_limit="truncated", step_limit=1)
    worlds.qpos[7, 0] = np.nan
    result = worlds.step(random_actions(worlds.task, (NUM_WORLDS,)))
    assert result.outcome[7] == Outcome.DIVERGED
    assert result.terminated[7]
    assert not result.truncated[7]
    assert np.delete(result.truncated, 7).all()


@every_task
@both_kinds
def test_the_dm_control_route_ends_the_episode_too(injure, name, silence):
    environment = gdrl_tasks.load(name, random=0)
    actions = random_actions(environment.task.task, (5,))
    environment.reset()
    environment.step(actions[0])
    injure(environment.physics.data.qpos, environment.physics.data.qvel)
    time_step = environment.step(actions[0])
    check_diverged(environment, time_step, actions, gdrl_tasks.load(name))


@every_task
def test_the_dm_control_route_ends_on_a_bad_action_too(name, silence):
    environment = gdrl_tasks.load(name, random=0, actions="continuous")
    actions = random_actions(environment.task.task, (5,))
    environment.reset()
    time_step = environment.step(np.array([0.5, np.nan]))
    fresh = gdrl_tasks.load(name, actions="continuous")
    check_diverged(environment, time_step, actions, fresh)


def check_diverged(environment, time_step, actions, fresh):
    assert time_step.last()
    assert time_step.discount == 0.0
    assert time_step.reward == -1.0
    assert environment.task.outcome == Outcome.DIVERGED
    for value in time_step.observation.values():
        assert np.isfinite(value).all()
    environment.task.next_episode_seed = 5
    again = environment.reset()
    fresh.task.next_episode_seed = 5
    for one, other in zip(
        [again, *(environment.step(action) for action in actions)],
        [fresh.reset(), *(fresh.step(action) for action in actions)],
        strict=True,
    ):
        assert one.reward == other.reward
        for key, value in one.observation.items():
            np.testing.assert_array_equal(value, other.observation[key])


def test_a_rough_sea_and_wild_actions_do_not_diverge(silence):
    worlds = started(
        "water", significant_wave_height_m=0.6, peak_period_s=2.5, current_m_s=0.5
    )
    generator = np.random.default_rng(0)
    for _ in range(60):
        running = np.flatnonzero(worlds.arrays["outcome"] == Outcome.RUNNING)
        action = np.sign(generator.normal(size=(NUM_WORLDS, 2)))
        result = worlds.step(action[running], running)
        assert not (result.outcome == Outcome.DIVERGED).any()
    assert len(running) > 40


@every_task
@both_kinds
@pytest.mark.parametrize("num_threads", [1, 2])
def test_the_step_that_diverged_is_told_once_and_can_be_repeated(
    injure, num_threads, name, silence
):
    worlds, diverged = started(name, num_threads), []
    worlds.watch(diverged.append)
    actions = random_actions(worlds.task, (4, NUM_WORLDS))
    for action in actions[:2]:
        worlds.step(action)
    assert diverged == []
    for world in (7, 41):
        injure(worlds.qpos[world], worlds.qvel[world])
    worlds.step(actions[2])
    others = np.delete(np.arange(NUM_WORLDS), [7, 41])
    worlds.step(actions[3, others], others)
    assert [told.world for told in diverged] == [7, 41]
    for told in diverged:
        assert told.steps == 2
        assert told.episode_seed == worlds.arrays["episode_seed"][told.world]
        again = repeat_step(worlds.task, told.before, told.action)
        assert again.arrays["outcome"] == Outcome.DIVERGED
        np.testing.assert_array_equal(again.qpos[0], told.qpos)
        np.testing.assert_array_equal(again.qvel[0], told.qvel)


@every_task
def test_a_step_is_repeated_bit_for_bit(name):
    """A world whose action is not a number, with the one that it should have had."""
    worlds, healthy = (started(name, actions="continuous") for _ in range(2))
    diverged = []
    worlds.watch(diverged.append)
    actions = random_actions(worlds.task, (5, NUM_WORLDS))
    for action in actions[:4]:
        worlds.step(action)
        healthy.step(action)
    expected = healthy.step(actions[4])
    wrong = actions[4].copy()
    wrong[7] = np.nan
    worlds.step(wrong)
    assert len(diverged) == 1
    again = repeat_step(worlds.task, diverged[0].before, actions[4, 7])
    np.testing.assert_array_equal(again.observe(), expected.observation[7:8])
    np.testing.assert_array_equal(again.qvel[0], healthy.qvel[7])
    np.testing.assert_array_equal(again.qpos[0], healthy.qpos[7])
