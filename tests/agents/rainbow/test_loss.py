"""Rainbow's loss against loops over transitions, atoms and actions."""

from __future__ import annotations

import copy
import math
import warnings

import hypothesis
import hypothesis.strategies as st
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import OneHot
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import DistributionalQValueActor
from torchrl.objectives import DistributionalDQNLoss

from gdrl_torchrl.agents.networks import make_value_network
from gdrl_torchrl.agents.rainbow.loss import (
    RainbowLoss,
    project,
    resample_noise,
    soft_update_target,
)
from gdrl_torchrl.agents.rainbow.n_step import NStep
from gdrl_torchrl.agents.rainbow.network import make_q_actor

SIZE, ACTIONS, ATOMS, GAMMA = 3, 4, 11, 0.9
LOW, HIGH = -1.0, 2.0
RETURNS = [LOW + (HIGH - LOW) * i / (ATOMS - 1) for i in range(ATOMS)]


def make(noisy=False, **options):
    """A loss whose online and target networks differ, and actors equal to both."""
    options = {"num_atoms": ATOMS, "num_cells": (8, 8), "noisy": noisy} | options
    actor = make_q_actor(SIZE, ACTIONS, value_range=(LOW, HIGH), **options)
    loss = RainbowLoss(actor, gamma=GAMMA)
    target = copy.deepcopy(actor)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.5 * torch.randn_like(parameter))
    return loss, actor, target


def make_batch(size=ATOMS, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return TensorDict(
        {
            "observation": 2.0 * normal(size, SIZE),
            "action": torch.randint(ACTIONS, (size,), generator=generator),
            "steps_to_next_obs": torch.randint(1, 6, (size, 1), generator=generator),
            "priority_weight": torch.rand(size, generator=generator) + 0.1,
            "next": {
                "observation": 2.0 * normal(size, SIZE),
                "reward": 0.6 * normal(size, 1),
                "terminated": normal(size, 1) > 0.5,
                "done": torch.zeros(size, 1, dtype=torch.bool),
            },
        },
        batch_size=[size],
    )


def brute_force_projection(chances, reward, discount, returns):
    """Each atom's probability, split between the two atoms around where it lands."""
    gap = (returns[-1] - returns[0]) / (len(returns) - 1)
    out, outside = [0.0] * len(returns), 0.0
    for chance, value in zip(chances, returns, strict=True):
        lands = reward + discount * value
        if lands < returns[0] - 1e-3 * gap or lands > returns[-1] + 1e-3 * gap:
            outside += chance
        lands = min(max(lands, returns[0]), returns[-1])
        for atom, other in enumerate(returns):
            out[atom] += chance * max(0.0, 1.0 - abs(lands - other) / gap)
    return out, outside


def distributions(actor, observation):
    """Probabilities ``[B][Z][A]`` in double precision, from the stock actor."""
    rows = TensorDict(observation=observation, batch_size=observation.shape[:1])
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        return actor(rows)["action_value"].double().exp().tolist()


def brute_force(online, target, batch, gamma=GAMMA, returns=RETURNS):
    """Cross-entropy, entropy of the target, value and clipped mass, per transition."""
    now = distributions(online, batch["observation"])
    ahead = distributions(online, batch["next", "observation"])
    delayed = distributions(target, batch["next", "observation"])
    rows = []
    for i in range(batch.batch_size[0]):
        means = [
            sum(ahead[i][z][a] * returns[z] for z in range(len(returns)))
            for a in range(len(ahead[i][0]))
        ]
        best = means.index(max(means))
        steps = int(batch["steps_to_next_obs"].reshape(-1)[i])
        ended = bool(batch["next", "terminated"][i, 0])
        projected, outside = brute_force_projection(
            [delayed[i][z][best] for z in range(len(returns))],
            float(batch["next", "reward"][i, 0]),
            0.0 if ended else gamma**steps,
            returns,
        )
        action = int(batch["action"].reshape(-1)[i])
        own = [now[i][z][action] for z in range(len(returns))]
        pairs = list(zip(projected, own, strict=True))
        rows.append(
            (
                -sum(m * math.log(p) for m, p in pairs),
                -sum(m * math.log(m) for m, _ in pairs if m > 0.0),
                sum(p * value for p, value in zip(own, returns, strict=True)),
                outside,
            )
        )
    return torch.tensor(rows, dtype=torch.float64).unbind(dim=-1)


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


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(
    atoms=st.integers(2, 60),
    low=st.floats(-50.0, 5.0),
    width=st.floats(0.5, 100.0),
    rewards=st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=4),
    discount=st.sampled_from([0.0, 0.3, 0.97, 1.0]),
    seed=st.integers(0, 1000),
)
def test_the_projection_equals_a_loop_and_keeps_mass_and_mean(
    atoms, low, width, rewards, discount, seed
):
    generator = torch.Generator().manual_seed(seed)
    support = torch.linspace(low, low + width, atoms, dtype=torch.float64)
    chances = torch.rand(len(rewards), atoms, generator=generator).double() ** 4
    chances /= chances.sum(dim=-1, keepdim=True)
    # In units of the width, so that some stay inside and some do not.
    reward = torch.tensor(rewards, dtype=torch.float64)[:, None] * width
    out, outside = project(chances, reward, torch.tensor([[discount]]).double(), support)
    assert torch.allclose(out.sum(dim=-1), torch.ones(len(rewards)).double())
    assert (out >= 0.0).all()
    for i, row in enumerate(chances.tolist()):
        expected, clipped = brute_force_projection(
            row, float(reward[i]), discount, support.tolist()
        )
        assert out[i].tolist() == pytest.approx(expected, abs=1e-6)
        assert float(outside[i]) == pytest.approx(clipped, abs=1e-6)
        if clipped == 0.0:
            mean = float(reward[i]) + discount * float((chances[i] * support).sum())
            tolerance = 1e-3 * width / (atoms - 1) + 1e-6  # of what counts as inside
            assert float((out[i] * support).sum()) == pytest.approx(mean, abs=tolerance)


@pytest.mark.parametrize(
    ("reward", "lands"), [(-5.0, 0), (0.0, 0), (1.0, 1), (3.0, 3), (4.0, 4), (9.0, 4)]
)
def test_a_value_on_an_atom_stays_there_and_one_beyond_the_ends_goes_to_them(reward, lands):
    support = torch.arange(5.0)
    chances = torch.full((1, 5), 0.2)
    out, outside = project(
        chances, torch.tensor([[reward]]), torch.zeros(1, 1), support
    )  # a terminal transition
    assert out[0].tolist() == pytest.approx([float(i == lands) for i in range(5)])
    assert float(outside) == pytest.approx(float(not 0.0 <= reward <= 4.0))


def test_nothing_is_clipped_by_bounds_that_no_reward_leads_out_of():
    # The lowest and highest rewards per step, and the values of getting them for ever.
    gamma, low, high = 0.99, -0.01, 0.02
    bounds = (low / (1 - gamma), high / (1 - gamma))
    actor = make_q_actor(SIZE, ACTIONS, value_range=bounds, num_cells=(8,))
    loss = RainbowLoss(actor, gamma=gamma)
    steps = torch.arange(1, 52)[:, None]
    batch = make_batch(51).set("steps_to_next_obs", steps)
    for per_step in (low, high):
        batch["next", "reward"] = per_step * (1 - gamma**steps) / (1 - gamma)
        assert float(loss(batch.clone())["clipped_mass"]) == 0.0
    batch["next", "reward"] = batch["next", "reward"] + 0.1
    assert float(loss(batch)["clipped_mass"]) > 0.0


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


def test_a_loss_restored_from_its_state_is_the_same():
    loss, *_ = make(noisy=True)
    other, *_ = make(noisy=True)
    batch = make_batch(9)
    assert loss(batch)["loss"] != other(batch)["loss"]
    other.load_state_dict(loss.state_dict())
    assert torch.equal(loss(batch)["loss"], other(batch)["loss"])


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
