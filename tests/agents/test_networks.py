"""Actors and critics: what they read and write, and within which bounds."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_torchrl.agents.networks import make_tanh_normal_actor, make_value_network

SPEC = Bounded(-1.0, 1.0, shape=(2,))


def rows(count=200, size=3):
    generator = torch.Generator().manual_seed(0)
    observation = 5.0 * torch.randn(count, size, generator=generator)
    return TensorDict(observation=observation, batch_size=[count])


@pytest.mark.parametrize(
    ("low", "high"), [([-1.0, -1.0], [1.0, 1.0]), ([0.0, -3.0], [2.0, -1.0])]
)
@pytest.mark.parametrize("how", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_actions_are_within_the_bounds(how, low, high):
    spec = Bounded(torch.tensor(low), torch.tensor(high))
    actor = make_tanh_normal_actor(3, spec)
    with set_exploration_type(how):
        out = actor(rows())
    assert (out["action"] >= torch.tensor(low)).all()
    assert (out["action"] <= torch.tensor(high)).all()
    assert spec.is_in(out["action"][0])


def test_the_greedy_action_is_the_squashed_mean():
    actor = make_tanh_normal_actor(3, SPEC)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        out = actor(rows())
    assert torch.allclose(out["action"], out["loc"].tanh(), atol=1e-5)


def test_the_standard_deviation_does_not_depend_on_the_state_and_starts_as_told():
    out = make_tanh_normal_actor(3, SPEC, initial_std=0.4)(rows())
    assert torch.allclose(out["scale"], torch.full((200, 2), 0.4), atol=1e-5)


def test_log_probabilities_are_those_of_a_squashed_normal():
    out = make_tanh_normal_actor(3, SPEC)(rows(50))
    before = out["action"].double().atanh()
    mean, std = out["loc"].double(), out["scale"].double()
    normal = -0.5 * ((before - mean) / std) ** 2 - std.log()
    normal -= 0.5 * torch.log(torch.tensor(2.0 * torch.pi))
    slope = torch.log(1.0 - out["action"].double() ** 2)
    inside = (out["action"].abs() < 0.999).all(dim=-1)
    expected = (normal - slope).sum(dim=-1)
    assert inside.sum() > 10
    assert torch.allclose(
        out["action_log_prob"].double()[inside], expected[inside], atol=1e-2
    )


def test_networks_have_the_widths_and_the_activation_that_are_asked_for():
    actor = make_tanh_normal_actor(3, SPEC, num_cells=(5, 7), activation=nn.ReLU)
    shapes = [tuple(m.weight.shape) for m in actor.modules() if isinstance(m, nn.Linear)]
    assert shapes == [(5, 3), (7, 5), (2, 7)]
    kinds = [type(m) for m in actor.modules() if isinstance(m, nn.ReLU | nn.Tanh)]
    assert kinds == [nn.ReLU, nn.ReLU]
    critic = make_value_network(3, num_cells=(4,), activation=nn.ReLU)
    shapes = [tuple(m.weight.shape) for m in critic.modules() if isinstance(m, nn.Linear)]
    assert shapes == [(4, 3), (1, 4)]


def test_a_critic_values_states_and_may_see_the_time():
    batch = rows(6).set("time_left", torch.rand(6, 1))
    blind, seeing = make_value_network(3), make_value_network(3, sees_time=True)
    assert blind(batch.clone())["state_value"].shape == (6, 1)
    later = batch.clone().set("time_left", batch["time_left"] + 0.5)
    values = seeing(batch.clone())["state_value"]
    assert (seeing(later.clone())["state_value"] != values).all()
    same = blind(batch.clone())["state_value"] == blind(later.clone())["state_value"]
    assert same.all()
