"""Safe mutations: a closed form, and the outputs of the children themselves."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Categorical

from gdrl_torchrl.agents.networks import make_argmax_actor
from gdrl_torchrl.evolution.hooks.breeding import breeding_of
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.operators.mutation import bernoulli_mutation
from gdrl_torchrl.evolution.operators.safe_mutation import safe_mutation
from gdrl_torchrl.evolution.population.outputs import outputs_of
from gdrl_torchrl.evolution.settings import EvolutionConfig

TARGETS = (0.003, 0.1, 1.0)
NAN, INF = float("nan"), float("inf")


def mutants(genome, count=6, *, std=0.1, mut_p=0.75, seed=1):
    return bernoulli_mutation(
        stack_copies(genome, count),
        mut_p=mut_p,
        std=std,
        generator=torch.Generator().manual_seed(seed),
    )


def linear(genome, observation):
    return genome["w"] @ observation


def acts_on(actor, rows):
    """What an actor's own modules write of rows, and what its greedy action follows."""
    out = actor(TensorDict(observation=rows, batch_size=[len(rows)]))
    if "loc" in out:
        return out["loc"]
    if "support" in dict(actor.named_buffers()):
        return torch.einsum("bka,k->ba", out["action_value"].exp(), actor.support)
    return out["action_value"] if "action_value" in out else out["raw"]


@torch.no_grad()
def shift(actor, population, number, member_of, rows):
    """How far a member's outputs are, of copies of the actor that nothing has batched."""
    before, after = (
        acts_on(actor, rows),
        acts_on(member_of(actor, population, number), rows),
    )
    return float(np.sqrt(np.mean((after - before).numpy() ** 2)) / np.std(before.numpy()))


# How far


@pytest.mark.parametrize("target", TARGETS)
def test_the_scale_of_a_linear_policy_is_the_one_in_closed_form(target):
    rng = np.random.default_rng(0)
    weights, noise = rng.normal(size=(2, 3)), rng.normal(size=(4, 2, 3))
    rows = rng.normal(size=(50, 3))
    found = safe_mutation(
        linear,
        TensorDict(w=torch.from_numpy(weights)),
        TensorDict(w=torch.from_numpy(weights + noise), batch_size=[4]),
        torch.from_numpy(rows),
        divergence=target,
    )["w"].numpy()
    # Each output's gradient is the observation, whatever the weights.
    directions = noise / np.abs(rows).mean(axis=0)
    for child, direction in zip(found, directions, strict=True):
        change = np.sqrt(np.mean((rows @ direction.T) ** 2))
        factor = target * np.std(rows @ weights.T, ddof=1) / change
        assert np.subtract(child, weights) == pytest.approx(factor * direction, rel=0.01)


@pytest.mark.parametrize("kind", ["tanh_normal", "q_value", "distributional"])
@pytest.mark.parametrize("target", TARGETS)
def test_outputs_of_every_child_are_as_far_as_asked(kind, target, actor_of, member_of):
    actor, rows = actor_of(kind), torch.randn(200, 3)
    genome = genome_of(actor)
    children = safe_mutation(
        outputs_of(actor), genome, mutants(genome), rows, divergence=target
    )
    for number in range(len(children)):
        found = shift(actor, children, number, member_of, rows)
        assert found == pytest.approx(target, rel=0.05)
    assert not (children[0] == children[1]).all()


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_how_large_the_mutation_was_does_not_matter(factor, actor_of):
    actor, rows = actor_of("q_value").double(), torch.randn(50, 3, dtype=torch.float64)
    genome = genome_of(actor)
    found = [
        safe_mutation(outputs_of(actor), genome, children, rows, divergence=0.1)
        for children in (mutants(genome, std=0.1), mutants(genome, std=0.1 * factor))
    ]
    for key, leaf in found[0].items(True, True):
        assert torch.allclose(leaf, found[1][key], rtol=1e-6, atol=1e-9)


def test_a_policy_with_other_weights_and_the_same_outputs_has_children_as_far(member_of):
    actor = make_argmax_actor(3, Categorical(5), num_cells=(8,))
    other, rows = copy.deepcopy(actor), torch.randn(200, 3)
    first, last = [layer for layer in other.modules() if isinstance(layer, nn.Linear)]
    with torch.no_grad():
        # A rectifier passes a positive factor on, and the next layer undoes it.
        first.weight.mul_(20.0)
        first.bias.mul_(20.0)
        last.weight.div_(20.0)
    assert torch.allclose(acts_on(actor, rows), acts_on(other, rows), atol=1e-5)
    for policy in (actor, other):
        genome = genome_of(policy)
        children = safe_mutation(
            outputs_of(policy), genome, mutants(genome), rows, divergence=0.2
        )
        for number in range(len(children)):
            found = shift(policy, children, number, member_of, rows)
            assert found == pytest.approx(0.2, rel=0.05)


def test_only_sensitive_directions_shrink_within_a_child():
    parent = TensorDict(w=torch.ones(2))
    children = TensorDict(w=torch.tensor([[2.0, 2.0], [2.0, 1.0]]), batch_size=[2])
    rows = torch.tensor([[4.0, 1.0], [-4.0, -1.0]])
    found = safe_mutation(
        lambda genome, x: genome["w"] * x, parent, children, rows, divergence=0.1
    )
    change = found["w"] - parent["w"]
    assert float(change[0, 1] / change[0, 0]) == pytest.approx(4.0, rel=1e-4)
    assert float(change[1, 1]) == 0.0


# What stays


def test_exploration_noise_of_a_policy_never_changes(actor_of):
    actor, rows = actor_of("tanh_normal"), torch.randn(50, 3)
    genome = genome_of(actor, exclude=())
    scale = [path for path in genome.keys(True, True) if "scale" in path[-1]]
    children = safe_mutation(
        outputs_of(actor), genome, mutants(genome), rows, divergence=0.1
    )
    assert scale
    for path, leaf in children.items(True, True):
        assert bool((leaf == genome[path]).all()) == (path in scale)


@pytest.mark.parametrize("strange", [NAN, INF, -INF])
def test_a_child_whose_outputs_are_no_numbers_stays_its_parent(strange, actor_of):
    actor, rows = actor_of("q_value"), torch.randn(20, 3)
    genome = genome_of(actor)
    children = mutants(genome, 3)
    first = next(iter(children.values(True, True)))
    first[1].view(-1)[0] = strange
    found = safe_mutation(outputs_of(actor), genome, children, rows, divergence=0.1)
    assert (found[1] == genome).all()
    for number in (0, 2):
        assert not (found[number] == genome).all()
    assert all(leaf.isfinite().all() for leaf in found.values(True, True))


def test_children_of_a_policy_whose_outputs_are_no_numbers_stay_as_it_is():
    parent = TensorDict(w=torch.tensor([[1.0, NAN]]), v=torch.ones(1, 2))
    rows = torch.randn(5, 2)
    found = safe_mutation(linear, parent, mutants(parent), rows, divergence=0.1)
    assert all(
        torch.equal(w, parent["w"].nan_to_num(9.0)) for w in found["w"].nan_to_num(9.0)
    )
    assert (found["v"] == 1.0).all()


@pytest.mark.parametrize("rows", [torch.zeros(5, 3), torch.ones(5, 3)])
def test_where_all_outputs_are_the_same_children_stay(rows):
    parent = TensorDict(w=torch.ones(2, 3))
    found = safe_mutation(linear, parent, mutants(parent), rows, divergence=0.1)
    assert (found["w"] == 1.0).all()


def bounded(genome, observation):
    return torch.tanh(genome["w"] * observation)


def near(genome, observation):
    """No numbers, once the weight is more than a tenth from 2."""
    return (genome["w"] + 0.0 * (0.1 - (genome["w"] - 2.0).abs()).sqrt()) * observation


@pytest.mark.parametrize(
    ("outputs", "far", "close"), [(bounded, 5.0, 0.001), (near, 0.5, 0.01)]
)
def test_outputs_that_cannot_go_as_far_leave_the_parent(outputs, far, close):
    parent = TensorDict(w=torch.full((1,), 2.0))
    rows = torch.tensor([[-1.0], [1.0]])
    for target, stays in ((far, True), (close, False)):
        found = safe_mutation(outputs, parent, mutants(parent), rows, divergence=target)
        changed = found["w"] != 2.0
        assert bool(changed.any()) != stays
        assert found["w"].isfinite().all()


def test_a_child_without_a_change_stays():
    parent = TensorDict(w=torch.randn(2, 3))
    copies = stack_copies(parent, 3)
    found = safe_mutation(linear, parent, copies, torch.randn(9, 3), divergence=0.1)
    assert (found == copies).all()


# What is asked for


@pytest.mark.parametrize("target", [0.0, -0.1, NAN])
def test_a_target_that_is_not_positive_is_refused(target):
    parent = TensorDict(w=torch.ones(2, 3))
    with pytest.raises(ValueError, match="divergence"):
        safe_mutation(linear, parent, mutants(parent), torch.randn(9, 3), divergence=target)


@pytest.mark.parametrize("options", [{}, {"genome": "head"}, {"crossover": "n_point"}])
def test_children_of_a_run_meet_the_target_whatever_else_is_asked_for(
    options, actor_of, member_of
):
    actor, rows = actor_of("distributional"), torch.randn(4, 16, 3)
    settings = EvolutionConfig(divergence=0.2, divergence_rows=64, **options)
    breeding = breeding_of(settings, actor)
    breeding.observe(TensorDict(observation=rows, batch_size=[4, 16]))
    genome = genome_of(actor)
    children = breeding(genome, None, generator=torch.Generator().manual_seed(0)).genomes
    for number in range(len(children)):
        found = shift(actor, children, number, member_of, rows.reshape(-1, 3))
        assert found == pytest.approx(0.2, rel=0.05)


def test_without_a_batch_no_safe_children_are_made(actor_of):
    actor = actor_of("q_value")
    breeding = breeding_of(EvolutionConfig(divergence=0.2), actor)
    with pytest.raises(RuntimeError, match="training batch"):
        breeding(genome_of(actor), None, generator=torch.Generator())
