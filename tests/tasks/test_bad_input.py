"""Bad input is refused at once, with an error that names the option and the value."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gdrl_tasks

BAD_WATER_OPTIONS = [
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
    ("significant_wave_height_m", 2.01),
    ("peak_period_s", 0.0),
    ("peak_period_s", 0.61),
    ("peak_period_s", 30.1),
    ("peak_period_s", 1e5),
    ("peak_period_s", float("nan")),
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
    ("control_interval_s", 10.0),
    ("control_interval_s", float("inf")),
    ("substep_s", 0.0),
    ("substep_s", 0.2),
    ("step_limit", 0),
    ("step_limit", 1.5),
    ("step_limit", True),
    ("wave_components", 0),
    ("wave_components", 12.0),
]
BAD_INDOOR_OPTIONS = [
    ("arena", "kitchen"),
    ("arena", None),
    ("arena", ["paper"]),
    ("actions", "five"),
    ("at_limit", "ended"),
    ("speed_m_s", 0.0),
    ("speed_m_s", -0.1),
    ("speed_m_s", 3.0),
    ("speed_m_s", float("nan")),
    ("speed_m_s", "fast"),
    ("speed_m_s", None),
    ("turn_rates_deg_s", ()),
    ("turn_rates_deg_s", (45.0,)),
    ("turn_rates_deg_s", (45.0, 45.0)),
    ("turn_rates_deg_s", (-200.0, 0.0)),
    ("turn_rates_deg_s", (0.0, float("nan"))),
    ("turn_rates_deg_s", ("left", "right")),
    ("turn_rates_deg_s", 90.0),
    ("turn_rates_deg_s", "wide"),
    ("turn_rates_deg_s", None),
    ("wheel_speed_limit", "waffle"),
    ("wheel_speed_limit", 0.22),
    ("goal_tolerance_m", 0.0),
    ("goal_tolerance_m", 0.6),
    ("goal_tolerance_m", None),
    ("num_beams", 0),
    ("num_beams", 361),
    ("num_beams", 19.0),
    ("num_beams", True),
    ("field_of_view_deg", 0.0),
    ("field_of_view_deg", 361.0),
    ("field_of_view_deg", float("inf")),
    ("range_noise", "no"),
    ("range_noise", 1),
    ("scan_hold", None),
    ("control_interval_s", 0.13),
    ("control_interval_s", 0.74),
    ("control_interval_s", 10.0),
    ("control_interval_s", float("inf")),
    ("substep_s", 0.0),
    ("substep_s", 0.05),
    ("step_limit", 0),
    ("step_limit", 1.5),
    ("step_limit", False),
]
BAD_OPTIONS = [("water", *bad) for bad in BAD_WATER_OPTIONS]
BAD_OPTIONS += [("indoor", *bad) for bad in BAD_INDOOR_OPTIONS]


@pytest.mark.parametrize("route", ["load", "simulate", "make_task"])
@pytest.mark.parametrize(("name", "option", "value"), BAD_OPTIONS)
def test_a_bad_value_is_named_on_every_route(route, name, option, value):
    make = getattr(gdrl_tasks, route)
    counts = {"num_worlds": 2} if route == "simulate" else {}
    named = rf"{option}=.*"
    if isinstance(value, int | float | str) or value is None:
        named += re.escape(str(value))
    with pytest.raises(ValueError, match=named):
        make(name, **counts, **{option: value})


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
def worlds(request):
    return gdrl_tasks.simulate(
        request.param, num_worlds=3, num_threads=1, seed=0, actions="continuous"
    )


@pytest.fixture(scope="module", params=["water", "indoor"])
def discrete_worlds(request):
    return gdrl_tasks.simulate(
        request.param, num_worlds=2, num_threads=1, seed=0, actions="discrete"
    )


def assert_refused(worlds, action, message):
    """A step with an action is refused and changes nothing."""
    worlds.reset()
    before = worlds.get_state()
    with pytest.raises(ValueError, match=message):
        worlds.step(action)
    for name, value in worlds.get_state().items():
        np.testing.assert_array_equal(value, before[name])


@pytest.mark.parametrize(
    "action",
    [np.zeros((2, 2)), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 2, 1)), 0.0],
    ids=lambda action: str(np.shape(action)),
)
def test_actions_of_another_shape_are_refused(worlds, action):
    assert_refused(worlds, action, re.escape(f"shape {np.shape(action)}"))


@pytest.mark.parametrize(
    "action",
    [np.zeros(3, dtype=int), np.zeros((2, 1), dtype=int), 1],
    ids=lambda action: str(np.shape(action)),
)
def test_discrete_actions_of_another_shape_are_refused(discrete_worlds, action):
    assert_refused(discrete_worlds, action, re.escape(f"shape {np.shape(action)}"))


@pytest.mark.parametrize("action", [[["a", "b"]] * 3, np.zeros((3, 2), complex), None])
def test_actions_that_are_not_real_numbers_are_refused(worlds, action):
    assert_refused(worlds, action, "must be real numbers")


@pytest.mark.parametrize("choice", [-1, 7, 100, 0.5])
def test_discrete_actions_out_of_range_are_named(discrete_worlds, choice):
    task = discrete_worlds.task
    most = {"water": 7, "indoor": 5}[task.name]
    message = re.escape(f"action={choice} must be an integer in [0, {most})")
    assert_refused(discrete_worlds, np.array([0, choice]), message)
    environment = gdrl_tasks.load(task.name, random=0, actions="discrete")
    environment.reset()
    with pytest.raises(ValueError, match=message):
        environment.step(choice)


@pytest.mark.parametrize("name", ["water", "indoor"])
@pytest.mark.parametrize("action", [np.zeros(3), np.zeros(1), 0.0, np.zeros((1, 2))])
def test_the_dm_control_route_refuses_other_shapes(action, name):
    environment = gdrl_tasks.load(name, random=0, actions="continuous")
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


CHOICES = ["near", "far", "calm", "lake", "rough", "sparse", "discrete", "continuous"]
CHOICES += ["paper", "scatter", "corridor", "burger", "truncated", ""]
VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 400),
    st.floats(),
    st.floats(0.0, 10.0),
    st.floats(0.0, 400.0),
    st.sampled_from(CHOICES),
    st.lists(st.floats(-90.0, 90.0), max_size=3).map(tuple),
    st.lists(st.sampled_from(["velocity", "roll", "time_left", "x"]), max_size=3),
)


def option_names(task):
    return [field.name for field in dataclasses.fields(gdrl_tasks.task_options(task))]


@pytest.mark.parametrize("task", ["water", "indoor"])
@given(data=st.data(), value=VALUES)
def test_any_option_either_works_or_is_named(task, data, value):
    name = data.draw(st.sampled_from(option_names(task)))
    refusal = None
    try:
        made = gdrl_tasks.make_task(task, **{name: value})
    except (ValueError, TypeError) as error:
        refusal = str(error)
    if refusal is not None:
        assert f"{name}=" in refusal
        return
    episode = made.draw_episode(0)
    assert np.isfinite(episode.qpos).all()
    for array in episode.arrays.values():
        assert np.isfinite(array).all()
    assert made.spec.num_substeps >= 1
    low, high = made.spec.observation_bounds
    assert (low < high).all()


@given(
    arena=st.sampled_from(["paper", "scatter", "corridor"]),
    speed=st.floats(0.01, 0.3),
    rates=st.lists(st.floats(-180.0, 180.0), min_size=2, max_size=5, unique=True),
    num_beams=st.integers(1, 60),
    field_of_view_deg=st.floats(1.0, 360.0),
    switches=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    substeps=st.integers(1, 8),
)
@settings(max_examples=25)
def test_any_robot_that_is_allowed_can_be_driven(
    arena, speed, rates, num_beams, field_of_view_deg, switches, substeps
):
    range_noise, scan_hold, limited = switches
    worlds = gdrl_tasks.simulate(
        "indoor",
        num_worlds=len(rates),
        num_threads=1,
        seed=0,
        arena=arena,
        speed_m_s=speed,
        turn_rates_deg_s=tuple(rates),
        num_beams=num_beams,
        field_of_view_deg=field_of_view_deg,
        range_noise=range_noise,
        scan_hold=scan_hold,
        wheel_speed_limit="burger" if limited else None,
        control_interval_s=0.02 * substeps,
    )
    low, high = worlds.task.spec.observation_bounds
    observation = worlds.reset()
    for _ in range(4):
        assert observation.shape == (len(rates), 2 + num_beams)
        assert ((low <= observation) & (observation <= high)).all()
        result = worlds.step(np.arange(len(rates)))
        observation = result.observation
        assert not (result.outcome == gdrl_tasks.Outcome.DIVERGED).any()


@given(
    distances=st.tuples(st.floats(0.5, 50.0), st.floats(0.5, 50.0)),
    tolerance=st.floats(0.01, 2.0),
    height=st.floats(0.0, 2.0),
    period=st.floats(0.62, 30.0),
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
    if height > 9.81 * period**2 / (2.0 * np.pi) / 15.0:
        with pytest.raises(ValueError, match="significant_wave_height_m="):
            gdrl_tasks.make_task("water", **options)
        return
    episode = gdrl_tasks.make_task("water", **options).draw_episode(seed)
    distance = np.hypot(*episode.arrays["goal"])
    assert near * (1.0 - 1e-12) <= distance <= far * (1.0 + 1e-12)
    deviation = np.sqrt(0.5 * (episode.arrays["amplitude"] ** 2).sum())
    assert 4.0 * deviation == pytest.approx(height)
