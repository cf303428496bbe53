"""Which weights the loss trains, whose noise it draws, and how the target follows."""

from __future__ import annotations

import copy

import pytest
import torch

from gdrl_torchrl.agents.rainbow.loss import RainbowLoss, resample_noise, soft_update_target
from gdrl_torchrl.agents.rainbow.network import make_q_actor
from tests.agents.rainbow.losses import (
    ATOMS,
    GAMMA,
    RETURNS,
    SIZE,
    distributions,
    make,
    make_batch,
)


@pytest.mark.parametrize("noisy", [False, True])
def test_every_online_parameter_learns_and_no_other(noisy):
    loss, actor, _ = make(noisy)
    loss(make_batch(16))["loss"].backward()
    names = dict(actor.named_parameters())
    assert noisy == any("sigma" in name for name in names)
    for name, parameter in names.items():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0.0, name
    assert {id(p) for p in loss.parameters()} == {id(p) for p in actor.parameters()}
    for leaf in loss.target_value_network_params.values(True, True):
        assert not leaf.requires_grad
        assert leaf.grad is None


def leaves(params, end):
    items = params.items(include_nested=True, leaves_only=True)
    return {k: v.detach().clone() for k, v in items if k[-1].endswith(end)}


def test_noise_is_drawn_anew_for_both_networks_and_differs_between_them():
    loss, actor, _ = make(noisy=True)
    both = (loss.value_network_params, loss.target_value_network_params)
    before = [leaves(params, "epsilon") for params in both]
    fixed = [
        leaves(params, ("mu", "sigma", "weight", "bias", "support")) for params in both
    ]
    resample_noise(loss)
    after = [leaves(params, "epsilon") for params in both]
    assert len(before[0]) == len(before[1]) == 8
    for old, new in zip(before, after, strict=True):
        assert all(not torch.equal(old[key], new[key]) for key in old)
    assert all(not torch.equal(after[0][key], after[1][key]) for key in after[0])
    for old, params in zip(fixed, both, strict=True):
        new = leaves(params, ("mu", "sigma", "weight", "bias", "support"))
        assert all(torch.equal(old[key], new[key]) for key in old)
    # The actor acts with the online network's noise.
    layer = actor.module[0].module.value[0]
    own = after[0]["module", "0", "module", "value", "0", "weight_epsilon"]
    assert torch.equal(layer.weight_epsilon, own)


@pytest.mark.parametrize("which", ["value_network_params", "target_value_network_params"])
def test_the_noise_of_either_network_changes_the_loss(which):
    loss, *_ = make(noisy=True)
    batch = make_batch(16)
    before = float(loss(batch)["loss"].detach())
    for key, value in getattr(loss, which).items(True, True):
        if key[-1] == "weight_epsilon":
            value.data.mul_(-1.0)
    assert float(loss(batch)["loss"].detach()) != pytest.approx(before, abs=1e-3)


def test_without_noisy_layers_nothing_is_drawn():
    loss, *_ = make()
    state = torch.get_rng_state()
    before = loss.state_dict()
    resample_noise(loss)
    assert torch.equal(state, torch.get_rng_state())
    assert all(torch.equal(before[key], value) for key, value in loss.state_dict().items())


@pytest.mark.parametrize("tau", [0.0, 0.1, 1.0])
def test_a_soft_update_moves_parameters_by_a_share_and_leaves_buffers(tau):
    loss, actor, target = make(noisy=True)
    resample_noise(loss)
    online_before = copy.deepcopy(actor.state_dict())
    target_before = dict(target.state_dict())
    params = loss.target_value_network_params
    places = {k: v.data_ptr() for k, v in params.items(True, True)}
    noise = leaves(params, "epsilon")
    soft_update_target(loss, tau)
    soft_update_target(loss, tau)
    for key, value in params.items(True, True):
        name = ".".join(key) if isinstance(key, tuple) else key
        assert value.data_ptr() == places[key], name
        if name.endswith("epsilon"):
            assert torch.equal(value, noise[key]), name
        elif name.endswith("support"):
            assert torch.allclose(value, torch.tensor(RETURNS))
        else:
            kept = (1.0 - tau) ** 2
            expected = kept * target_before[name] + (1.0 - kept) * online_before[name]
            assert torch.allclose(value, expected, atol=1e-6), name
            if tau < 1.0:
                assert not torch.allclose(value, online_before[name], atol=1e-3), name
    for name, value in actor.state_dict().items():
        assert torch.equal(value, online_before[name]), name


def test_it_learns_the_expected_returns_of_two_actions():
    actor = make_q_actor(SIZE, 2, value_range=(-1.0, 1.0), num_atoms=ATOMS, num_cells=(8,))
    loss = RainbowLoss(actor, gamma=GAMMA)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.02)
    batch = make_batch(32)
    batch["observation"].fill_(0.5)
    batch["action"] = torch.arange(32) % 2
    # Action 0 pays -0.4; action 1 pays 0.75 or -0.25 with equal chances.
    pays = torch.tensor([-0.4, 0.75, -0.4, -0.25]).repeat(8)
    batch["next", "reward"] = pays[:, None]
    batch["next", "terminated"].fill_(True)
    for _ in range(150):
        optimizer.zero_grad()
        loss(batch)["loss"].backward()
        optimizer.step()
    chances = torch.tensor(distributions(actor, batch["observation"][:1])[0])
    mean = (chances * torch.linspace(-1.0, 1.0, ATOMS)[:, None]).sum(dim=0)
    assert mean.tolist() == pytest.approx([-0.4, 0.25], abs=0.03)
    assert 0.4 < chances[8:, 1].sum() < 0.6


def test_a_loss_restored_from_its_state_is_the_same():
    loss, *_ = make(noisy=True)
    other, *_ = make(noisy=True)
    batch = make_batch(9)
    assert loss(batch)["loss"] != other(batch)["loss"]
    other.load_state_dict(loss.state_dict())
    assert torch.equal(loss(batch)["loss"], other(batch)["loss"])


@pytest.mark.parametrize("calls", [1, 2, 3])
def test_an_exception_in_the_network_leaves_it_with_its_weights(calls):
    """Of the online network, twice, and of the target network."""
    loss, actor, _ = make()
    network, seen = actor.module[0], []

    def fail(module, inputs):
        seen.append(inputs)
        if len(seen) == calls:
            raise RuntimeError("out of order")

    objects = {name: id(value) for name, value in actor.named_parameters()}
    values = {name: value.clone() for name, value in actor.named_parameters()}
    handle = network.register_forward_pre_hook(fail)
    with pytest.raises(RuntimeError, match="out of order"):
        loss(make_batch())
    handle.remove()
    assert {name: id(value) for name, value in actor.named_parameters()} == objects
    assert all(torch.equal(p, values[name]) for name, p in actor.named_parameters())
