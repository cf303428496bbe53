"""Bad input is refused at once, with an error that names the option and the value."""

import re

import numpy as np
import pytest

import gdrl_tasks

# The range of every number and the choices of every word are in tests/config; here is
# what a range alone does not say, and one number, word and switch of each task.
BAD_OPTIONS = [
    ("water", "difficulty", None),
    ("water", "sea", "stormy"),
    ("water", "sea", []),
    ("water", "significant_wave_height_m", float("nan")),
    ("water", "peak_period_s", 30.1),
    ("water", "goal_distance_m", (6.0, 2.0)),
    ("water", "goal_distance_m", (1.0, 2.0, 3.0)),
    ("water", "goal_distance_m", 5.0),
    ("water", "goal_distance_m", ()),
    ("water", "goal_tolerance_m", 2.0),
    ("water", "extra_observations", ("velocity", "depth")),
    ("water", "extra_observations", "roll"),
    ("water", "extra_observations", None),
    ("water", "dead_zone_compensated", "no"),
    ("water", "control_interval_s", 0.26),
    ("water", "control_interval_s", 10.0),
    ("water", "substep_s", 0.2),
    ("water", "step_limit", 1.5),
    ("indoor", "arena", "kitchen"),
    ("indoor", "arena", ["paper"]),
    ("indoor", "speed_m_s", 3.0),
    ("indoor", "turn_rates_deg_s", ()),
    ("indoor", "turn_rates_deg_s", (45.0,)),
    ("indoor", "turn_rates_deg_s", (45.0, 45.0)),
    ("indoor", "turn_rates_deg_s", (0.0, float("nan"))),
    ("indoor", "turn_rates_deg_s", ("left", "right")),
    ("indoor", "turn_rates_deg_s", 90.0),
    ("indoor", "turn_rates_deg_s", "wide"),
    ("indoor", "turn_rates_deg_s", None),
    ("indoor", "wheel_speed_limit", 0.22),
    ("indoor", "goal_tolerance_m", None),
    ("indoor", "num_beams", True),
    ("indoor", "range_noise", 1),
    ("indoor", "control_interval_s", 0.13),
    ("indoor", "control_interval_s", 0.74),
    ("indoor", "substep_s", 0.05),
]


def assert_named(make, name, option, value, **options):
    named = rf"{option}=.*"
    if isinstance(value, int | float | str) or value is None:
        named += re.escape(str(value))
    with pytest.raises(ValueError, match=named):
        make(name, **options, **{option: value})


@pytest.mark.parametrize(("name", "option", "value"), BAD_OPTIONS)
def test_a_bad_value_is_named(name, option, value):
    assert_named(gdrl_tasks.make_task, name, option, value)


@pytest.mark.parametrize(("name", "option"), [("water", "sea"), ("indoor", "arena")])
def test_a_bad_value_is_named_on_every_route(name, option):
    assert_named(gdrl_tasks.load, name, option, "stormy")
    assert_named(gdrl_tasks.simulate, name, option, "stormy", num_worlds=2)


STEEP = r"1/15; set significant_wave_height_m to {} or less, or peak_period_s to {} or more"


@pytest.mark.parametrize(
    ("options", "allowed", "message"),
    [
        # Wavelengths by g T^2 / 2 pi: 0.600, 1.561, 30.09 m; 0.797 of lake, 1.561 of calm.
        ({"peak_period_s": 0.62}, (0.04, 0.041), (0.04, 0.63)),
        ({"peak_period_s": 1.0}, (0.104, 0.105), (0.104, 1.01)),
        ({"peak_period_s": 4.38, "sea": "rough"}, (1.996, 2.0), (1.996, 4.39)),
        ({"sea": "lake"}, (0.053, 0.054), (0.053, 0.73)),
        ({"sea": "rough"}, (0.133, 0.14), (0.133, 1.16)),
        ({"sea": "calm"}, (0.104, 0.2), (0.104, 1.39)),
    ],
)
def test_a_sea_that_is_too_steep_is_refused_with_the_limit(options, allowed, message):
    inside, outside = (
        {"significant_wave_height_m": height} | options for height in allowed
    )
    gdrl_tasks.make_task("water", **inside)
    named = ", ".join(f"{name}={value}" for name, value in outside.items() if name != "sea")
    with pytest.raises(ValueError, match=STEEP.format(*message)) as refused:
        gdrl_tasks.make_task("water", **outside)
    for name in named.split(", "):
        assert name in str(refused.value)
    # What the message advises is accepted.
    height, period = message
    gdrl_tasks.make_task("water", **outside | {"significant_wave_height_m": height})
    gdrl_tasks.make_task("water", **outside | {"peak_period_s": period})


def test_a_period_too_short_for_the_heights_of_a_sea_is_refused():
    with pytest.raises(
        ValueError, match=r"peak_period_s=1\.5 with heights up to 0\.25 m of sea='rough'"
    ):
        gdrl_tasks.make_task("water", sea="rough", peak_period_s=1.5)
    gdrl_tasks.make_task("water", sea="rough", peak_period_s=1.56)
    gdrl_tasks.make_task("water", sea="calm", peak_period_s=0.62)


def test_an_unknown_task_or_option_is_named_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'waters' must be one of .*'indoor', 'water'"):
        gdrl_tasks.load("waters")
    with pytest.raises(ValueError, match=r"unknown option tide=2\.0 .*'sea'"):
        gdrl_tasks.simulate("water", num_worlds=1, tide=2.0)
    with pytest.raises(ValueError, match=r"unknown option sea='calm' .*'arena'"):
        gdrl_tasks.make_task("indoor", sea="calm")


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


@pytest.fixture(scope="module", params=["water", "indoor"])
def task_name(request):
    return request.param


@pytest.fixture(scope="module")
def worlds(task_name):
    return gdrl_tasks.simulate(
        task_name, num_worlds=3, num_threads=1, seed=0, actions="continuous"
    )


@pytest.fixture(scope="module")
def discrete_worlds(task_name):
    return gdrl_tasks.simulate(
        task_name, num_worlds=2, num_threads=1, seed=0, actions="discrete"
    )


def assert_refused(worlds, action, message):
    """A step with an action is refused and changes nothing."""
    worlds.reset()
    before = worlds.get_state()
    with pytest.raises(ValueError, match=message):
        worlds.step(action)
    for name, value in worlds.get_state().items():
        np.testing.assert_array_equal(value, before[name])


def test_actions_of_another_shape_are_refused(worlds, discrete_worlds):
    for shape in ((2, 2), (3, 3), (3,), (3, 2, 1), ()):
        assert_refused(worlds, np.zeros(shape), re.escape(f"shape {shape}"))
    for shape in ((3,), (2, 1), ()):
        action = np.zeros(shape, dtype=int)
        assert_refused(discrete_worlds, action, re.escape(f"shape {shape}"))


def test_actions_that_are_not_real_numbers_are_refused(worlds):
    for action in ([["a", "b"]] * 3, np.zeros((3, 2), complex), None):
        assert_refused(worlds, action, "must be real numbers")


def test_discrete_actions_out_of_range_are_named(discrete_worlds):
    task = discrete_worlds.task
    most = {"water": 7, "indoor": 5}[task.name]
    environment = gdrl_tasks.load(task.name, random=0, actions="discrete")
    environment.reset()
    for choice in (-1, 7, 100, 0.5):
        message = re.escape(f"action={choice} must be an integer in [0, {most})")
        assert_refused(discrete_worlds, np.array([0, choice]), message)
        with pytest.raises(ValueError, match=message):
            environment.step(choice)


@pytest.mark.parametrize("name", ["water", "indoor"])
def test_the_dm_control_route_refuses_other_shapes(name):
    environment = gdrl_tasks.load(name, random=0, actions="continuous")
    environment.reset()
    for action in (np.zeros(3), np.zeros(1), 0.0, np.zeros((1, 2))):
        with pytest.raises(ValueError, match="must have shape"):
            environment.step(action)


def test_bad_worlds_are_named(worlds):
    worlds.reset()
    for ids in ([3], [-1], [1, 0], [1, 1], [0.5], [True, False, True], [[0]]):
        with pytest.raises(ValueError, match="ids"):
            worlds.step(np.zeros((len(ids), 2)), ids)
        with pytest.raises(ValueError, match="ids"):
            worlds.reset(ids)
        with pytest.raises(ValueError, match="ids"):
            worlds.observe(ids)


def test_bad_seeds_are_named(worlds):
    for seeds in ([1, 2], [1, 2, -3], [1.5, 2.0, 3.0], 4):
        with pytest.raises(ValueError, match="seeds"):
            worlds.reset(seeds=seeds)


def test_no_worlds_may_be_stepped_or_reset(worlds):
    worlds.reset()
    before = worlds.get_state()
    shape = (0, worlds.task.spec.observation_size)
    assert worlds.reset([]).shape == shape
    assert worlds.step(np.zeros((0, 2)), []).reward.shape == (0,)
    assert worlds.observe([]).shape == shape
    for name, value in worlds.get_state().items():
        np.testing.assert_array_equal(value, before[name])


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
