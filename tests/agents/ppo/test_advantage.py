"""The compiled advantages are TorchRL's, bit for bit."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.objectives.value import GAE

from gdrl_torchrl.agents.networks import make_value_network
from gdrl_torchrl.agents.ppo.advantage import CompiledGAE


def make_batch(worlds, steps, seed, *, ends=0.1):
    """Random transitions ``[W, T]`` whose episodes end in both ways."""
    torch.manual_seed(seed)

    def rows():
        size = (worlds, steps)
        return {"observation": torch.randn(*size, 3), "time_left": torch.rand(*size, 1)}

    terminated, truncated = (torch.rand(worlds, steps, 1) < ends for _ in range(2))
    following = rows() | {"reward": torch.randn(worlds, steps, 1)}
    following |= {"terminated": terminated, "truncated": truncated & ~terminated}
    following["done"] = terminated | truncated
    return TensorDict({**rows(), "next": following}, batch_size=[worlds, steps])


def both(critic, gamma=0.99, lmbda=0.95):
    torchrls = GAE(
        gamma=gamma,
        lmbda=lmbda,
        value_network=critic,
        shifted=False,
        deactivate_vmap=True,
    )
    return torchrls, CompiledGAE(gamma=gamma, lmbda=lmbda, value_network=critic)


def assert_equal(expected, found):
    assert sorted(expected.keys(True, True), key=str) == sorted(
        found.keys(True, True), key=str
    )
    for key, value in expected.items(True, True):
        assert torch.equal(value.nan_to_num(-77.0), found[key].nan_to_num(-77.0)), key
        assert torch.equal(value.isnan(), found[key].isnan()), key
        assert not found[key].requires_grad


@settings(deadline=None, max_examples=40)
@given(
    worlds=st.integers(1, 5),
    steps=st.integers(1, 40),
    seed=st.integers(0, 2**31),
    ends=st.sampled_from([0.0, 0.1, 0.7, 1.0]),
    gamma=st.floats(0.0, 1.0),
    lmbda=st.floats(0.0, 1.0),
)
def test_any_batch_gets_torchrls_numbers(worlds, steps, seed, ends, gamma, lmbda):
    batch = make_batch(worlds, steps, seed, ends=ends)
    torchrls, compiled = both(make_value_network(3, num_cells=(8,)), gamma, lmbda)
    assert_equal(torchrls(batch.clone()), compiled(batch.clone()))


def test_weights_that_change_between_epochs_are_seen():
    critic = make_value_network(3, num_cells=(8, 8))
    torchrls, compiled = both(critic)
    batch = make_batch(1, 256, 0)
    for _ in range(3):
        assert_equal(torchrls(batch.clone()), compiled(batch.clone()))
        with torch.no_grad():
            for weight in critic.parameters():
                weight.add_(torch.randn_like(weight), alpha=0.1)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_a_number_goes_as_far_as_it_does_with_torchrl(value):
    """The check of updates must find it: it may not be lost at an episode's end."""
    batch = make_batch(3, 20, 0)
    batch["next", "reward"][1, 9] = value
    batch["observation"][0, 5] = value
    batch["next", "terminated"][1, 12] = batch["next", "done"][1, 12] = True
    torchrls, compiled = both(make_value_network(3, num_cells=(8,)))
    found = compiled(batch.clone())
    assert_equal(torchrls(batch.clone()), found)
    assert not found["advantage"].isfinite().all()


def test_a_batch_that_is_a_view_of_another_gets_the_same_numbers():
    batch = make_batch(6, 30, 0)
    torchrls, compiled = both(make_value_network(3, num_cells=(8,)))
    view = batch[::2, 5:]
    assert_equal(torchrls(view.clone()), compiled(view.copy()))
