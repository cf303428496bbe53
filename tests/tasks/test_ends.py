"""An episode's end is final, none is stepped before it begins, and vessels can capsize."""

import mujoco
import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import Outcome, make_task
from gdrl_tasks.definition import decide_outcome

every_task = pytest.mark.parametrize("name", ["water", "indoor"])


def worlds_of(name, num_worlds=4, **options):
    return gdrl_tasks.simulate(
        name, num_worlds=num_worlds, num_threads=1, seed=0, **options
    )


def action_of(worlds, count=4):
    spec = worlds.task.spec
    return np.zeros(count if spec.is_discrete else (count, spec.action_size), dtype=int)


@every_task
def test_a_step_before_the_first_reset_is_an_error_that_names_a_world(name):
    worlds = worlds_of(name)
    with pytest.raises(RuntimeError, match=r"4 of 4 worlds \(world 0: none has begun\)"):
        worlds.step(action_of(worlds))
    worlds.reset(np.array([0, 2]))
    with pytest.raises(RuntimeError, match=r"2 of 4 worlds \(world 1: none has begun\)"):
        worlds.step(action_of(worlds))
    worlds.step(action_of(worlds, 2), np.array([0, 2]))
    assert worlds.arrays["steps"].tolist() == [1, 0, 1, 0]


@every_task
@pytest.mark.parametrize("at_limit", ["terminated", "truncated"])
def test_a_world_that_has_ended_stays_as_it_was_until_its_reset(name, at_limit):
    worlds = worlds_of(name, step_limit=2, at_limit=at_limit)
    worlds.reset()
    for _ in range(2):
        result = worlds.step(action_of(worlds))
    assert (result.outcome == Outcome.TIMEOUT).all()
    before = worlds.get_state()
    for ids in (None, np.array([1, 2])):
        count = 4 if ids is None else 2
        with pytest.raises(RuntimeError, match="it ended: TIMEOUT"):
            worlds.step(action_of(worlds, count), ids)
    for key, value in worlds.get_state().items():
        np.testing.assert_array_equal(value, before[key])
    worlds.reset(np.array([1]))
    assert worlds.step(action_of(worlds, 1), np.array([1])).outcome == [Outcome.RUNNING]


def test_success_stays_success():
    worlds = worlds_of("water", sea="calm")
    worlds.reset()
    worlds.arrays["goal"][2] = worlds.arrays["position"][2]
    assert worlds.step(action_of(worlds)).outcome[2] == Outcome.SUCCESS
    with pytest.raises(RuntimeError, match=r"1 of 4 worlds \(world 2: it ended: SUCCESS"):
        worlds.step(action_of(worlds))
    assert worlds.arrays["episode_return"][2] == 1.0


def upside_down(qpos):
    """Turn a hull by half a turn around its own length."""
    w, x, y, z = qpos[3:7].copy()
    qpos[3:7] = -x, w, z, -y


def test_a_vessel_upside_down_has_capsized_on_both_routes():
    worlds = worlds_of("water", sea="calm", at_limit="truncated", step_limit=1)
    worlds.reset(seeds=np.arange(4))
    for world in (1, 3):
        upside_down(worlds.qpos[world])
    # It has reached its goal and its last step, too.
    worlds.arrays["goal"][3] = worlds.arrays["position"][3]
    result = worlds.step(np.ones((4, 2)))
    names = [Outcome(int(outcome)).name for outcome in result.outcome]
    assert names == ["TIMEOUT", "CAPSIZED", "TIMEOUT", "CAPSIZED"]
    assert result.reward[[1, 3]].tolist() == [-1.0, -1.0]
    assert result.terminated.tolist() == [False, True, False, True]
    assert result.truncated.tolist() == [True, False, True, False]
    environment = gdrl_tasks.load("water", sea="calm")
    environment.reset()
    upside_down(environment.physics.data.qpos)
    time_step = environment.step(np.ones(2))
    assert (time_step.reward, time_step.discount) == (-1.0, 0.0)
    assert environment.task.outcome == Outcome.CAPSIZED


def test_to_capsize_is_to_turn_the_own_vertical_axis_below_the_horizon():
    task = make_task("water")
    generator = np.random.default_rng(0)
    qpos = generator.normal(size=(500, 7))
    qpos[:, 3:] /= np.linalg.norm(qpos[:, 3:], axis=1, keepdims=True)
    for row, heel in enumerate(np.radians([0.0, 45.0, 89.0, 91.0, 179.0])):
        qpos[row, 3:] = np.cos(0.5 * heel), np.sin(0.5 * heel), 0.0, 0.0
    matrix = np.zeros(9)
    expected = []
    for row in qpos:
        mujoco.mju_quat2Mat(matrix, row[3:])
        expected.append(matrix[8] < 0.0)
    capsized = task.capsizes({}, np.arange(500), qpos)
    np.testing.assert_array_equal(capsized, expected)
    assert capsized[:5].tolist() == [False, False, False, True, True]


def test_a_robot_on_wheels_never_capsizes():
    worlds = worlds_of("indoor")
    worlds.reset()
    assert not worlds.task.capsizes(worlds.arrays, np.arange(4), worlds.qpos).any()


def test_one_outcome_hides_the_others_in_order():
    """A table of all 32 cases against the order that the tasks' READMEs state."""
    cases = np.array(np.meshgrid(*[[False, True]] * 5)).reshape(5, -1)
    outcome = decide_outcome(*cases)
    names = ("success", "collision", "timeout", "diverged", "capsized")
    order = ("diverged", "capsized", "success", "collision", "timeout")
    for case, result in zip(cases.T, outcome, strict=True):
        happened = dict(zip(names, case, strict=True))
        first = next((name for name in order if happened[name]), "running")
        assert Outcome(int(result)).name.lower() == first


def test_figures_and_videos_show_every_outcome():
    from gdrl_torchrl.pictures import captions, style

    names = {outcome.name.lower() for outcome in Outcome}
    colours = style.OUTCOME_COLOURS
    assert names == set(colours) == set(style.OUTCOME_DASHES)
    assert names == set(captions._OUTCOME_COLOURS)
    assert len(set(colours.values())) == len(names)
