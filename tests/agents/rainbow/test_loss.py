"""Rainbow's loss against loops over transitions, atoms and actions."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import OneHot
from torchrl.modules import DistributionalQValueActor
from torchrl.objectives import DistributionalDQNLoss

from gdrl_torchrl.agents.networks import make_value_network
from gdrl_torchrl.agents.rainbow.loss import RainbowLoss, resample_noise, soft_update_target
from gdrl_torchrl.agents.rainbow.n_step import NStep
from gdrl_torchrl.agents.rainbow.network import make_q_actor
from tests.agents.rainbow.losses import (
    ACTIONS,
    ATOMS,
    GAMMA,
    HIGH,
    LOW,
    RETURNS,
    SIZE,
    brute_force,
    brute_force_projection,
    distributions,
    make,
    make_batch,
)


@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("size", [1, 5, ATOMS])
def test_the_loss_equals_loops_over_transitions_atoms_and_actions(noisy, size):
    loss, online, target = make(noisy)
    batch = make_batch(size)
    cross_entropy, entropy, value, outside = brute_force(online, target, batch)
    out = loss(batch)
    weight = batch["priority_weight"].double()
    expected = (weight * cross_entropy).mean()
    assert float(out["loss"].detach()) == pytest.approx(float(expected), rel=1e-4)
    assert batch["td_error"].shape == (size, 1)
    assert torch.allclose(
        batch["td_error"][:, 0].double(), cross_entropy - entropy, atol=1e-4
    )
    assert float(out["q_mean"]) == pytest.approx(float(value.mean()), abs=1e-4)
    assert float(out["clipped_mass"]) == pytest.approx(float(outside.mean()), abs=1e-4)
    assert float(outside.sum()) > 0.0 or size == 1


@pytest.mark.parametrize("key", ["steps_to_next_obs", "action", "priority_weight"])
def test_the_shape_of_flat_entries_does_not_matter_even_with_as_many_rows_as_atoms(key):
    loss, *_ = make()
    batch = make_batch(ATOMS)
    flat, tall = batch.clone(), batch.clone()
    flat[key] = batch[key].reshape(ATOMS)
    tall[key] = batch[key].reshape(ATOMS, 1)
    assert torch.equal(loss(flat)["loss"], loss(tall)["loss"])
    assert torch.equal(flat["td_error"], tall["td_error"])


def test_weights_multiply_each_loss_and_do_not_divide_the_sum():
    loss, online, target = make()
    batch = make_batch(6)
    cross_entropy, *_ = brute_force(online, target, batch)
    weight = torch.tensor([1.0, 0.1, 0.2, 0.0, 0.4, 0.3])
    batch["priority_weight"] = weight
    expected = sum(float(w * c) for w, c in zip(weight, cross_entropy, strict=True)) / 6
    assert float(loss(batch)["loss"].detach()) == pytest.approx(expected, rel=1e-4)
    del batch["priority_weight"]
    unweighted = float(cross_entropy.mean())
    assert float(loss(batch)["loss"].detach()) == pytest.approx(unweighted, rel=1e-4)


@pytest.mark.parametrize("size", [7, ATOMS])
@pytest.mark.parametrize("one_hot", [False, True])
def test_uniform_one_step_data_give_the_loss_and_the_gradients_of_torchrl(size, one_hot):
    spec = OneHot(ACTIONS) if one_hot else None
    loss, actor, _ = make(spec=spec)
    stock = DistributionalDQNLoss(actor, gamma=GAMMA)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a missing updater
        stock.load_state_dict(loss.state_dict())
    batch = make_batch(size).exclude("priority_weight", "steps_to_next_obs")
    if one_hot:
        batch["action"] = nn.functional.one_hot(batch["action"], ACTIONS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a missing updater
        expected = stock(batch.clone())["loss"]
    own = loss(batch)["loss"]
    assert torch.allclose(own, expected, atol=1e-6)
    gradients = [torch.autograd.grad(v, list(actor.parameters())) for v in (own, expected)]
    for mine, theirs in zip(*gradients, strict=True):
        assert torch.allclose(mine, theirs, atol=1e-6)


def test_the_online_network_selects_and_the_target_network_values():
    actor = make_q_actor(1, 2, value_range=(0.0, 2.0), num_atoms=3, num_cells=(4,))
    bias = actor.module[0].module.advantage[-1].bias.data
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.zero_()
        # Rows are atoms. The target prefers action 0, the online network action 1.
        bias.copy_(torch.tensor([[0.0, 5.0], [0.0, 0.0], [5.0, 0.0]]).T.flatten())
    loss = RainbowLoss(actor, gamma=1.0)
    with torch.no_grad():
        bias.copy_(torch.tensor([[4.0, 0.0], [0.0, 0.0], [0.0, 4.0]]).T.flatten())
    batch = TensorDict(
        {
            "observation": torch.zeros(1, 1),
            "action": torch.tensor([1]),
            "next": {
                "observation": torch.zeros(1, 1),
                "reward": torch.zeros(1, 1),
                "terminated": torch.zeros(1, 1, dtype=torch.bool),
            },
        },
        batch_size=[1],
    )

    # Advantages are taken from the mean over both actions.
    def chances(*logits):
        return torch.tensor(logits, dtype=torch.float64).softmax(-1)

    delayed_of_action_1 = chances(2.5, 0.0, -2.5)
    own_of_action_1 = chances(-2.0, 0.0, 2.0)
    expected = -(delayed_of_action_1 * own_of_action_1.log()).sum()
    assert float(loss(batch)["loss"].detach()) == pytest.approx(float(expected), rel=1e-5)


def test_a_window_that_ends_in_a_terminal_state_is_not_continued_by_a_value():
    loss, online, target = make()
    transitions = make_batch(8).select("observation", "action", "next")
    done = torch.arange(8)[:, None] == 4
    transitions["next", "terminated"] = done
    transitions["next", "done"] = done
    batch = NStep(GAMMA, 3)(transitions)
    # The first window that contains the end, by hand: three rewards and nothing more.
    rewards = transitions["next", "reward"][2:5, 0].tolist()
    total = rewards[0] + GAMMA * rewards[1] + GAMMA**2 * rewards[2]
    expected, _ = brute_force_projection([1.0] + [0.0] * (ATOMS - 1), total, 0.0, RETURNS)
    own = distributions(online, transitions["observation"])[2]
    action = int(transitions["action"][2])
    by_hand = -sum(m * math.log(own[z][action]) for z, m in enumerate(expected))
    one = batch[2:3].clone()
    assert float(loss(one)["loss"].detach()) == pytest.approx(by_hand, rel=1e-4)
    # And all windows, of which some are continued.
    assert (
        batch["next", "terminated"][:, 0].tolist() == [False] * 2 + [True] * 3 + [False] * 3
    )
    cross_entropy, *_ = brute_force(online, target, batch)
    assert float(loss(batch)["loss"].detach()) == pytest.approx(
        float(cross_entropy.mean()), rel=1e-4
    )


def test_a_truncated_window_is_continued():
    loss, online, target = make()
    batch = make_batch(5)
    batch["next", "terminated"] = torch.zeros(5, 1, dtype=torch.bool)
    batch["next", "done"] = torch.ones(5, 1, dtype=torch.bool)
    cross_entropy, *_ = brute_force(online, target, batch)
    expected = float((batch["priority_weight"].double() * cross_entropy).mean())
    assert float(loss(batch)["loss"].detach()) == pytest.approx(expected, rel=1e-4)


def test_priorities_are_0_where_nothing_is_left_to_learn():
    actor = make_q_actor(
        SIZE, ACTIONS, value_range=(LOW, HIGH), num_atoms=4, num_cells=(8,)
    )
    # All returns but 0, the second, are as good as impossible.
    with torch.no_grad():
        bias = actor.module[0].module.value[-1].bias
        bias.copy_(torch.tensor([0.0, 60.0, 0.0, 0.0]))
    loss = RainbowLoss(actor, gamma=GAMMA)
    batch = make_batch(50)
    batch["next", "reward"].zero_()
    loss(batch)
    assert (batch["td_error"] >= 0.0).all()
    assert (batch["td_error"] < 1e-5).all()
    # The entropy of an uncertain target is no reason to see it again.
    with torch.no_grad():
        bias.zero_()
        # All actions are alike.
        actor.module[0].module.advantage[-1].weight.zero_()
    soft_update_target(loss, 1.0)
    batch["next", "terminated"].zero_()
    batch["next", "observation"] = batch["observation"]
    still = RainbowLoss(actor, gamma=1.0)
    out = still(batch)
    assert float(out["loss"].detach()) > 0.1
    assert (batch["td_error"] < 1e-5).all()


def test_a_batch_is_only_given_priorities_and_no_warning_is_raised():
    loss, *_ = make(noisy=True)
    batch = make_batch(6)
    before = batch.clone()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = loss(batch)
        soft_update_target(loss, 0.5)
        resample_noise(loss)
    assert (batch.exclude("td_error") == before).all()
    assert not batch["td_error"].requires_grad
    assert {key: value.requires_grad for key, value in out.items()} == {
        "loss": True,
        "q_mean": False,
        "clipped_mass": False,
    }


def test_unusable_networks_batches_and_shares_are_refused():
    with pytest.raises(ValueError, match="DistributionalQValueActor"):
        RainbowLoss(make_value_network(SIZE), gamma=GAMMA)
    for support in ([0.0, 1.0, 3.0], [1.0, 0.0, -1.0]):
        uneven = DistributionalQValueActor(
            nn.Linear(SIZE, 3), support=torch.tensor(support), spec=OneHot(1)
        )
        with pytest.raises(ValueError, match="support"):
            RainbowLoss(uneven, gamma=GAMMA)
    loss, *_ = make()
    with pytest.raises(ValueError, match="one dimension"):
        loss(make_batch(6).reshape(2, 3))
    with pytest.raises(ValueError, match="tau"):
        soft_update_target(loss, 1.5)


def test_it_says_what_it_reads_and_refuses_batches_without_it():
    loss, *_ = make()
    assert "RainbowLoss" in repr(loss)
    batch = make_batch(6).select(*loss.in_keys)
    assert set(loss(batch).keys()) == set(loss.out_keys)
    # Truncated transitions are done too: TorchRL's loss would take that flag instead.
    with pytest.raises(KeyError, match="terminated"):
        loss(make_batch(6).exclude(("next", "terminated")))
