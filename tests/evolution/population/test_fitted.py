"""Greedy actions that can be differentiated are those that the policy takes."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal

from gdrl_torchrl.evolution.operators.genome import genome_of, install, stack_copies
from gdrl_torchrl.evolution.operators.mutation import bernoulli_mutation
from gdrl_torchrl.evolution.population.fitted import greedy_actions_of
from gdrl_torchrl.private_copy import private_copy


def sac_actor():
    """An actor as of TorchRL's examples of SAC: nobody has prepared it."""
    network = nn.Sequential(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, 4))
    head = NormalParamExtractor()
    module = TensorDictModule(
        nn.Sequential(network, head), in_keys=["observation"], out_keys=["loc", "scale"]
    )
    return ProbabilisticActor(
        module,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -2.0, "high": 1.0},
        default_interaction_type=ExplorationType.RANDOM,
    )


@pytest.fixture(params=["tanh_normal", "sac"])
def policy(request, actor_of):
    torch.manual_seed(0)
    return sac_actor() if request.param == "sac" else actor_of("tanh_normal")


@pytest.fixture
def members(policy):
    rng = torch.Generator().manual_seed(1)
    copies = stack_copies(genome_of(policy), 4)
    return bernoulli_mutation(copies, mut_p=1.0, std=0.5, generator=rng)


def test_each_member_acts_as_the_policy_with_its_weights(policy, members):
    rows = torch.randn(4, 6, 3)
    actions = greedy_actions_of(policy)(members)(rows)
    for genome, seen, action in zip(members, rows, actions, strict=True):
        alone = private_copy(policy)
        install(alone, genome)
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            expected = alone(TensorDict(observation=seen, batch_size=[6]))["action"]
        torch.testing.assert_close(action, expected)


def test_gradients_are_those_of_differences(policy, members):
    rows = torch.randn(4, 6, 3)
    bind = greedy_actions_of(policy)
    genomes = members.clone()
    leaf = next(iter(genomes.values(include_nested=True, leaves_only=True)))
    leaf.requires_grad_()
    bind(genomes)(rows).square().sum().backward()
    assert leaf.grad is not None
    where = (2, *[0] * (leaf.ndim - 1))
    values = []
    for step in (1e-2, -1e-2):
        moved = members.clone()
        next(iter(moved.values(include_nested=True, leaves_only=True)))[where] += step
        values.append(float(bind(moved)(rows).square().sum()))
    expected = (values[0] - values[1]) / 2e-2
    assert float(leaf.grad[where]) == pytest.approx(expected, rel=0.05, abs=2e-3)


def test_it_follows_changes_in_place_and_leaves_the_policy_alone(policy, members):
    before = genome_of(policy)
    genomes = members.clone()
    act = greedy_actions_of(policy)(genomes)
    rows = torch.randn(4, 6, 3)
    first = act(rows).detach().clone()
    genomes.apply_(lambda leaf: leaf.mul_(0.5))
    assert not torch.allclose(act(rows), first)
    assert (genome_of(policy) == before).all()


def test_a_policy_of_another_entry_is_refused(actor_of):
    actor = TensorDictModule(nn.Linear(3, 2), in_keys=["pixels"], out_keys=["action"])
    with pytest.raises(ValueError, match=r"reads \['pixels'\]: only one that reads"):
        greedy_actions_of(actor)
