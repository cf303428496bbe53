"""Distributional actors: shapes, streams, noise, and as members of a population."""

from __future__ import annotations

import copy
import itertools

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Categorical, OneHot
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import NoisyLinear, reset_noise

from gdrl_torchrl.agents.rainbow.network import make_q_actor
from gdrl_torchrl.evolution.operators.genome import genome_of, install
from gdrl_torchrl.evolution.population.actor import PopulationActor

NOISY, GREEDY = ExplorationType.RANDOM, ExplorationType.DETERMINISTIC
SIZE, ACTIONS, ATOMS = 3, 4, 7


def make(**options):
    options = {
        "value_range": (-1.0, 2.0),
        "num_atoms": ATOMS,
        "num_cells": (6, 5),
    } | options
    return make_q_actor(SIZE, ACTIONS, **options)


def rows(count=20):
    generator = torch.Generator().manual_seed(0)
    observation = 2.0 * torch.randn(count, SIZE, generator=generator)
    return TensorDict(observation=observation, batch_size=[count])


def network_of(actor):
    return actor.module[0].module


def values_of(actor, how=GREEDY):
    with set_exploration_type(how), torch.no_grad():
        return actor(rows())["action_value"]


@pytest.mark.parametrize("noisy", [False, True])
def test_it_writes_a_distribution_per_action_and_the_action_with_the_best_mean(noisy):
    actor = make(noisy=noisy)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.mul_(4.0)  # so that no action is always the best
    out = actor(rows())
    assert out["action_value"].shape == (20, ATOMS, ACTIONS)
    chances = out["action_value"].detach().double().exp()
    assert torch.allclose(chances.sum(dim=1), torch.ones(20, ACTIONS).double(), atol=1e-5)
    returns = [-1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0]
    mean = sum(chances[:, i] * value for i, value in enumerate(returns))
    assert (out["action"] == mean.argmax(dim=-1)).all()
    assert len(set(out["action"].tolist())) > 1


@pytest.mark.parametrize(
    ("num_cells", "shared", "stream"),
    [((6,), [6], []), ((6, 5), [6], [5]), ((6, 5, 4), [6, 5], [4])],
)
def test_the_last_width_is_a_layer_of_each_stream_and_the_others_are_shared(
    num_cells, shared, stream
):
    network = network_of(make(num_cells=num_cells, activation=nn.Tanh))

    def widths(part):
        return [(m.in_features, m.out_features) for m in part if isinstance(m, nn.Linear)]

    def chain(*sizes):
        return list(itertools.pairwise(sizes))

    assert widths(network.features) == chain(SIZE, *shared)
    assert widths(network.advantage) == chain(shared[-1], *stream, ATOMS * ACTIONS)
    assert widths(network.value) == chain(shared[-1], *stream, ATOMS)
    # An activation after every hidden layer, and none at the end of a stream.
    for part, count in ((network.features, shared), (network.value, stream)):
        assert sum(isinstance(m, nn.Tanh) for m in part) == len(count)
    assert isinstance(network.advantage[-1], nn.Linear)


def test_advantages_only_move_actions_apart():
    network = network_of(make())
    observation = rows()["observation"]
    value = network.value(network.features(observation))
    assert torch.allclose(network(observation).mean(dim=-1), value, atol=1e-5)


@pytest.mark.parametrize("noisy", [False, True])
def test_noise_is_in_the_streams_only_and_as_large_as_asked_for(noisy):
    network = network_of(make(noisy=noisy, noisy_std=0.3))
    kind = NoisyLinear if noisy else nn.Linear
    for stream in (network.value, network.advantage):
        assert [type(m) for m in stream if isinstance(m, nn.Linear)] == [kind, kind]
    assert all(type(m) is not NoisyLinear for m in network.features)
    if noisy:
        scale = network.value[0].weight_sigma
        assert torch.allclose(scale, torch.full_like(scale, 0.3 / 6**0.5))


def test_greedy_actions_have_no_noise_and_random_ones_have_that_drawn_last():
    actor = make(noisy=True)
    greedy, noisy = values_of(actor), values_of(actor, NOISY)
    assert not torch.allclose(greedy, noisy, atol=1e-3)
    assert torch.equal(noisy, values_of(actor, NOISY))
    with torch.no_grad():
        outside = actor(rows())["action_value"]
    assert torch.equal(outside, greedy)
    actor.apply(reset_noise)
    assert torch.equal(greedy, values_of(actor))
    assert not torch.allclose(noisy, values_of(actor, NOISY), atol=1e-3)


def test_training_mode_does_not_switch_the_noise():
    actor = make(noisy=True)
    for how in (GREEDY, NOISY):
        assert torch.equal(values_of(actor.train(), how), values_of(actor.eval(), how))


def test_an_actor_without_noise_is_the_same_in_both_modes():
    actor = make()
    assert torch.equal(values_of(actor), values_of(actor, NOISY))


def test_means_evolve_and_the_scales_of_the_noise_do_not():
    actor = make(noisy=True)
    genome = genome_of(actor)
    last = {key[-1] for key in genome.keys(True, True)}
    assert last == {"weight", "bias", "weight_mu", "bias_mu"}
    other = make(noisy=True)
    install(other, genome)
    assert torch.equal(values_of(other), values_of(actor))
    assert not torch.equal(values_of(other, NOISY), values_of(actor, NOISY))


@pytest.mark.parametrize("how", [GREEDY, NOISY])
@pytest.mark.parametrize("noisy", [False, True])
def test_members_of_a_population_equal_actors_of_their_own(
    noisy, how, population_of, member_of
):
    actor = make(noisy=noisy)
    genomes = population_of(actor, 5)
    before = copy.deepcopy(actor.state_dict())
    population = PopulationActor(actor)
    population.load(genomes)
    alone = rows()
    with set_exploration_type(how):
        out = population(torch.cat([alone] * 5)).reshape(5, 20)
        for number in range(5):
            expected = member_of(actor, genomes, number)(alone.clone())
            assert torch.allclose(
                out[number]["action_value"], expected["action_value"], atol=1e-5
            )
            assert (out[number]["action"] == expected["action"]).all()
    assert not torch.allclose(out[0]["action_value"], out[1]["action_value"], atol=1e-2)
    assert all(torch.equal(before[k], v) for k, v in actor.state_dict().items())


def test_actions_may_be_one_hot():
    out = make(spec=OneHot(ACTIONS))(rows())
    assert out["action"].shape == (20, ACTIONS)
    assert (out["action"].sum(dim=-1) == 1).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"value_range": (1.0, 1.0)}, "value_range"),
        ({"num_atoms": 1}, "num_atoms"),
        ({"num_cells": ()}, "num_cells"),
        ({"num_cells": (5, 0)}, "num_cells"),
        ({"spec": Categorical(ACTIONS + 1)}, "num_actions"),
    ],
)
def test_unusable_sizes_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make(**options)
