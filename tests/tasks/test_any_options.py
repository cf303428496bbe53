"""Any options of a task either work or are named."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gdrl_tasks

CHOICES = ["near", "far", "calm", "lake", "rough", "sparse", "discrete", "continuous"]
CHOICES += ["paper", "scatter", "corridor", "trap", "burger", "truncated", ""]
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
    arena=st.sampled_from(["paper", "scatter", "corridor", "trap"]),
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
