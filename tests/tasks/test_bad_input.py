"""Bad input is refused at once, with an error that names the option and the value."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gdrl_tasks
from gdrl_tasks.water.task import WaterOptions

BAD_OPTIONS = [
    ("difficulty", "hard"),
    ("difficulty", None),
    ("sea", "stormy"),
    ("sea", []),
    ("reward", None),
    ("at_limit", "ended"),
    ("actions", "seven"),
    ("significant_wave_height_m", -0.1),
    ("significant_wave_height_m", float("nan")),
    ("significant_wave_height_m", "high"),
    ("peak_period_s", 0.0),
    ("goal_distance_m", (6.0, 2.0)),
    ("goal_distance_m", (1.0, 2.0, 3.0)),
    ("goal_distance_m", 5.0),
    ("goal_distance_m", ()),
    ("goal_tolerance_m", 0.0),
    ("goal_tolerance_m", 2.0),
    ("extra_observations", ("velocity", "depth")),
    ("extra_observations", "roll"),
    ("extra_observations", None),
    ("dead_zone_compensated", "no"),
    ("current_m_s", -1.0),
    ("control_interval_s", 0.26),
    ("control_interval_s", float("inf")),
    ("substep_s", 0.0),
    ("substep_s", 0.2),
    ("step_limit", 0),
    ("step_limit", 1.5),
    ("step_limit", True),
    ("wave_components", 0),
    ("wave_components", 12.0),
]


@pytest.mark.parametrize("route", ["load", "simulate", "make_task"])
@pytest.mark.parametrize(("option", "value"), BAD_OPTIONS)
def test_a_bad_value_is_named_on_every_route(route, option, value):
    make = getattr(gdrl_tasks, route)
    counts = {"num_worlds": 2} if route == "simulate" else {}
    named = rf"{option}=.*"
    if isinstance(value, int | float | str) or value is None:
        named += re.escape(str(value))
    with pytest.raises(ValueError, match=named):
        make("water", **counts, **{option: value})


def test_an_unknown_task_or_option_is_named_with_the_known_ones():
    with pytest.raises(ValueError, match=r"task='waters' must be one of \['water'"):
        gdrl_tasks.load("waters")
    with pytest.raises(ValueError, match=r"unknown option tide=2\.0 .*'sea'"):
        gdrl_tasks.simulate("water", num_worlds=1, tide=2.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_worlds", 0),
        ("num_worlds", -3),
        ("num_worlds", 2.5),
        ("num_worlds", True),
        ("num_threads", -1),
        ("num_threads", "two"),
        ("seed", -1),
    ],
)
def test_bad_counts_are_named(name, value):
    with pytest.raises(ValueError, match=f"{name}={value!r} must be an integer"):
        gdrl_tasks.simulate("water", **({"num_worlds": 2} | {name: value}))


@pytest.fixture(scope="module")
def worlds():
    return gdrl_tasks.simulate("water", num_worlds=3, num_threads=1)


@pytest.fixture(scope="module")
def discrete_worlds():
    return gdrl_tasks.simulate("water", num_worlds=2, num_threads=1, actions="discrete")


@pytest.mark.parametrize(
    "action",
    [np.zeros((2, 2)), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 2, 1)), 0.0],
    ids=lambda action: str(np.shape(action)),
)
def test_actions_of_another_shape_are_refused(worlds, action):
    worlds.reset()
    before = worlds.get_state()
    with pytest.raises(ValueError, match=re.escape(f"shape {np.shape(action)}")):
        worlds.step(action)
    for name, value in worlds.get_state().items():
        np.testing.assert_array_equal(value, before[name])


@pytest.mark.parametrize("action", [[["a", "b"]] * 3, np.zeros((3, 2), complex), None])
def test_actions_that_are_not_real_numbers_are_refused(worlds, action):
    worlds.reset()
    with pytest.raises(ValueError, match="must be real numbers"):
        worlds.step(action)


@pytest.mark.parametrize("choice", [-1, 7, 100, 0.5])
def test_discrete_actions_out_of_range_are_named(discrete_worlds, choice):
    discrete_worlds.reset()
    message = re.escape(f"action={choice} must be an integer in [0, 7)")
    with pytest.raises(ValueError, match=message):
        discrete_worlds.step(np.array([0, choice]))
    environment = gdrl_tasks.load("water", random=0, actions="discrete")
    environment.reset()
    with pytest.raises(ValueError, match=message):
        environment.step(choice)


@pytest.mark.parametrize("action", [np.zeros(3), np.zeros(1), 0.0, np.zeros((1, 2))])
def test_the_dm_control_route_refuses_other_shapes(action):
    environment = gdrl_tasks.load("water", random=0)
    environment.reset()
    with pytest.raises(ValueError, match="must have shape"):
        environment.step(action)


@pytest.mark.parametrize(
    "ids", [[3], [-1], [1, 0], [1, 1], [0.5], [True, False, True], [[0]]], ids=str
)
def test_bad_worlds_are_named(worlds, ids):
    worlds.reset()
    with pytest.raises(ValueError, match="ids"):
        worlds.step(np.zeros((len(ids), 2)), ids)
    with pytest.raises(ValueError, match="ids"):
        worlds.reset(ids)
    with pytest.raises(ValueError, match="ids"):
        worlds.observe(ids)


@pytest.mark.parametrize("seeds", [[1, 2], [1, 2, -3], [1.5, 2.0, 3.0], 4])
def test_bad_seeds_are_named(worlds, seeds):
    with pytest.raises(ValueError, match="seeds"):
        worlds.reset(seeds=seeds)


def test_no_worlds_may_be_stepped_or_reset(worlds):
    worlds.reset()
    assert worlds.reset([]).shape == (0, 3)
    assert worlds.step(np.zeros((0, 2)), []).reward.shape == (0,)


def test_a_state_of_another_simulation_is_refused(worlds):
    worlds.reset()
    state = worlds.get_state()
    with pytest.raises(ValueError, match=r"arrays\.goal"):
        worlds.set_state(state | {"arrays.goal": np.zeros((2, 2))})
    del state["engine"]
    with pytest.raises(ValueError, match="engine"):
        worlds.set_state(state)


@pytest.mark.parametrize(("name", "values"), [("seed", (-1, 0, 1)), ("count", (0, 0, -1))])
def test_bad_episode_numbers_are_named(name, values):
    with pytest.raises(ValueError, match=f"{name}=-1"):
        gdrl_tasks.episode_seeds(gdrl_tasks.Stream.TRAINING, *values)


VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 300),
    st.floats(),
    st.floats(0.0, 10.0),
    st.sampled_from(["near", "far", "calm", "lake", "rough", "sparse", "discrete", ""]),
    st.lists(st.floats(0.0, 30.0), max_size=3).map(tuple),
    st.lists(st.sampled_from(["velocity", "roll", "time_left", "x"]), max_size=3),
)


@given(
    name=st.sampled_from([field.name for field in dataclasses.fields(WaterOptions)]),
    value=VALUES,
)
def test_any_option_either_works_or_is_named(name, value):
    refusal = None
    try:
        task = gdrl_tasks.make_task("water", **{name: value})
    except (ValueError, TypeError) as error:
        refusal = str(error)
    if refusal is not None:
        assert f"{name}=" in refusal
        return
    episode = task.draw_episode(0)
    assert np.isfinite(episode.qpos).all()
    for array in episode.arrays.values():
        assert np.isfinite(array).all()
    assert task.spec.num_substeps >= 1
    low, high = task.spec.observation_bounds
    assert (low < high).all()


@given(
    distances=st.tuples(st.floats(0.5, 50.0), st.floats(0.5, 50.0)),
    tolerance=st.floats(0.01, 2.0),
    height=st.floats(0.0, 2.0),
    period=st.floats(0.4, 50.0),
    seed=st.integers(0, 2**62),
)
def test_episodes_are_as_the_options_say(distances, tolerance, height, period, seed):
    near, far = sorted(distances)
    options = {
        "goal_distance_m": (near, far),
        "goal_tolerance_m": tolerance,
        "significant_wave_height_m": height,
        "peak_period_s": period,
    }
    if tolerance >= near:
        with pytest.raises(ValueError, match="goal_tolerance_m="):
            gdrl_tasks.make_task("water", **options)
        return
    episode = gdrl_tasks.make_task("water", **options).draw_episode(seed)
    distance = np.hypot(*episode.arrays["goal"])
    assert near * (1.0 - 1e-12) <= distance <= far * (1.0 + 1e-12)
    deviation = np.sqrt(0.5 * (episode.arrays["amplitude"] ** 2).sum())
    assert 4.0 * deviation == pytest.approx(height)
