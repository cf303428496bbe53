"""Genomes: which parameters evolve, copying them out, writing them back."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import MLP, NoisyLinear

from gdrl_torchrl.evolution.operators.genome import (
    concatenate,
    genome_of,
    install,
    stack_copies,
)


def names(genome):
    return {
        path if isinstance(path, str) else ".".join(path)
        for path in genome.keys(include_nested=True, leaves_only=True)
    }


def snapshot(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def unchanged(module, before):
    return all((module.state_dict()[n] == value).all() for n, value in before.items())


def test_a_genome_is_a_detached_copy(actor_kind, actor_of):
    actor = actor_of(actor_kind)
    before = snapshot(actor)
    genome = genome_of(actor)
    assert genome.batch_size == torch.Size([])
    for value in genome.values(include_nested=True, leaves_only=True):
        assert not value.requires_grad
        assert not isinstance(value, nn.Parameter)
        value.add_(1.0)
    assert unchanged(actor, before)


def test_a_genome_holds_the_parameters_under_their_own_names(actor_kind, actor_of):
    actor = actor_of(actor_kind)
    expected = {
        name: value
        for name, value in actor.named_parameters()
        if not name.endswith("state_independent_scale")
    }
    genome = genome_of(actor)
    assert names(genome) == set(expected)
    for name, value in expected.items():
        assert (genome[tuple(name.split("."))] == value).all()


def test_buffers_never_evolve(actor_of):
    distributional = actor_of("distributional")
    assert any("support" in name for name, _ in distributional.named_buffers())
    assert not any("support" in name for name in names(genome_of(distributional)))
    normed = nn.Sequential(nn.Linear(2, 2), nn.BatchNorm1d(2))
    assert names(genome_of(normed)) == {"0.weight", "0.bias", "1.weight", "1.bias"}


def test_what_a_greedy_fitness_cannot_see_does_not_evolve_unless_asked(actor_of):
    actor = actor_of("tanh_normal")
    assert not any("scale" in name for name in names(genome_of(actor)))
    assert any("scale" in name for name in names(genome_of(actor, exclude=())))
    noisy = MLP(in_features=2, out_features=1, num_cells=[3], layer_class=NoisyLinear)
    assert not any("sigma" in name for name in names(genome_of(noisy)))
    assert any("mu" in name for name in names(genome_of(noisy)))
    weights_only = names(genome_of(nn.Linear(2, 2), exclude=["bias"]))
    assert weights_only == {"weight"}


def test_installing_writes_into_the_same_parameter_objects(
    actor_kind, actor_of, population_of, member_of
):
    actor = actor_of(actor_kind)
    optimizer = torch.optim.Adam(actor.parameters())
    population = population_of(actor, 2)
    expected = member_of(actor, population, 1).state_dict()
    objects = {n: (id(p), p.data_ptr()) for n, p in actor.named_parameters()}
    install(actor, population[1])
    assert {n: (id(p), p.data_ptr()) for n, p in actor.named_parameters()} == objects
    assert all(p.requires_grad and p.grad_fn is None for p in actor.parameters())
    assert all((actor.state_dict()[n] == v).all() for n, v in expected.items())
    assert {id(p) for g in optimizer.param_groups for p in g["params"]} == {
        id(p) for p in actor.parameters()
    }


def test_what_a_genome_lacks_stays_as_it_is(actor_of):
    actor = actor_of("tanh_normal")
    before = snapshot(actor)
    install(actor, genome_of(actor).zero_())
    for name, value in actor.state_dict().items():
        kept = name.endswith("state_independent_scale")
        assert (value == (before[name] if kept else 0.0)).all(), name


def test_an_installed_genome_does_not_share_memory(actor_of):
    actor = actor_of("deterministic")
    genome = genome_of(actor).zero_()
    install(actor, genome)
    genome.apply_(lambda leaf: leaf.fill_(3.0))
    assert all((p == 0.0).all() for p in actor.parameters())


def test_a_genome_that_does_not_fit_is_refused_by_name():
    layer = nn.Linear(3, 2)
    before = snapshot(layer)
    with pytest.raises(ValueError, match="Linear has no parameter 'gain'"):
        install(layer, TensorDict(gain=torch.ones(2)))
    with pytest.raises(ValueError, match=r"weight has shape \(2, 3\).*\(3, 2\)"):
        install(layer, TensorDict(weight=torch.ones(3, 2)))
    assert unchanged(layer, before)


def test_a_genome_that_does_not_fit_leaves_the_module_as_it_was():
    layer = nn.Linear(3, 2)
    before = snapshot(layer)
    wrong = TensorDict(weight=torch.ones(2, 3), bias=torch.ones(7))
    with pytest.raises(ValueError, match="bias"):
        install(layer, wrong)
    assert unchanged(layer, before)


def test_lazy_layers_are_refused_by_name():
    with pytest.raises(ValueError, match=r"'0\.weight' is lazy"):
        genome_of(nn.Sequential(nn.LazyLinear(2)))


def test_a_module_without_parameters_is_refused():
    with pytest.raises(ValueError, match="Tanh has no parameters that evolve"):
        genome_of(nn.Tanh())
    with pytest.raises(ValueError, match="Linear has no parameters that evolve"):
        genome_of(nn.Linear(2, 2), exclude=["weight", "bias"])


def test_copies_have_memory_of_their_own():
    genome = genome_of(nn.Linear(3, 2))
    copies = stack_copies(genome, 4)
    assert copies.batch_size == torch.Size([4])
    copies["weight"][1] = 7.0
    assert not (copies["weight"][0] == 7.0).any()
    assert not (genome["weight"] == 7.0).any()


def test_populations_join_in_order():
    one, two = (stack_copies(genome_of(nn.Linear(3, 2)), n) for n in (1, 3))
    joined = concatenate([one, two])
    assert joined.batch_size == torch.Size([4])
    assert (joined["weight"][:1] == one["weight"]).all()
    assert (joined["weight"][1:] == two["weight"]).all()
