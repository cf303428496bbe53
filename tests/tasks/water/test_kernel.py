"""The compiled forces are those of the array functions, in numpy and in torch."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gdrl_tasks.water.hull import HullParameters, make_hull
from gdrl_tasks.water.kernel import sea_arrays, substep, substep_constants
from gdrl_tasks.water.sines import sines
from tests.tasks.water.hulls import (
    HULL,
    NUM_WORLDS,
    SUBSTEP_S,
    State,
    array_wrench,
    random_state,
)


def kernel_wrench(state, ids, *, compensated=False):
    thrust = state.thrust.copy()
    wrench = np.full((NUM_WORLDS, 6), np.nan)
    substep(
        ids,
        state.qpos,
        state.qvel,
        state.time,
        wrench,
        thrust,
        state.command,
        state.current,
        sea_arrays(state.sea),
        substep_constants(HULL, SUBSTEP_S, compensated),
    )
    return wrench, thrust


@pytest.mark.parametrize("compensated", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_the_kernel_is_the_array_function(seed, compensated):
    state = random_state(seed)
    expected, thrust = array_wrench(state, compensated=compensated)
    wrench, kernel_thrust = kernel_wrench(
        state, np.arange(NUM_WORLDS), compensated=compensated
    )
    # Both sum forces that may cancel: errors are relative to the largest of them.
    tolerance = 1e-12 * np.abs(expected).max()
    np.testing.assert_allclose(wrench, expected, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(kernel_thrust, thrust, rtol=1e-13)


def test_the_kernel_writes_only_the_worlds_it_is_given():
    state = random_state(0)
    ids = np.array([1, 5, 7])
    wrench, thrust = kernel_wrench(state, ids)
    others = np.setdiff1d(np.arange(NUM_WORLDS), ids)
    assert np.isfinite(wrench[ids]).all()
    assert np.isnan(wrench[others]).all()
    np.testing.assert_array_equal(thrust[others], state.thrust[others])


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40))
@example([0.0, -0.0, math.pi / 4, -math.pi / 4, math.pi / 2, 3 * math.pi, 1e6, -1e6])
def test_sines_are_those_of_the_mathematics(angles):
    cosine, sine = np.empty(len(angles)), np.empty(len(angles))
    sines(np.array(angles), cosine, sine)
    np.testing.assert_allclose(cosine, [math.cos(x) for x in angles], rtol=0, atol=5e-16)
    np.testing.assert_allclose(sine, [math.sin(x) for x in angles], rtol=0, atol=5e-16)


@pytest.mark.parametrize("angle", [math.nan, math.inf, -math.inf])
def test_there_is_no_sine_of_what_is_no_angle(angle):
    cosine, sine = np.zeros(5), np.zeros(5)
    sines(np.full(5, angle), cosine, sine)
    assert np.isnan(cosine).all()
    assert np.isnan(sine).all()


def test_a_hull_of_too_many_points_is_refused():
    with pytest.raises(ValueError, match="66 points"):
        substep_constants(make_hull(HullParameters(stations=33)), SUBSTEP_S, False)


def test_torch_gives_the_same_forces_as_numpy():
    torch = pytest.importorskip("torch")
    state = random_state(11)
    expected, thrust = array_wrench(state)
    tensors = State(
        *(torch.from_numpy(getattr(state, name)) for name in list(vars(state))[:-1]),
        sea={name: torch.from_numpy(value) for name, value in state.sea.items()},
    )
    wrench, tensor_thrust = array_wrench(tensors)
    tolerance = 1e-12 * np.abs(expected).max()
    np.testing.assert_allclose(wrench.numpy(), expected, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(tensor_thrust.numpy(), thrust, rtol=1e-13)
