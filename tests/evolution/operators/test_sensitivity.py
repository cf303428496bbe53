"""Sensitivity against finite differences, and changes that are divided by it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.operators.sensitivity import (
    divide_by_sensitivity,
    output_sensitivity,
)
from gdrl_torchrl.evolution.population.outputs import outputs_of


@pytest.mark.parametrize("rows", [1, 5, 70])
def test_it_is_the_mean_absolute_finite_difference(rows, actor_kind, actor_of):
    torch.manual_seed(0)
    actor = actor_of(actor_kind).double()
    genome, outputs = genome_of(actor), outputs_of(actor)
    observations = torch.randn(rows, 3, dtype=torch.float64)
    found = output_sensitivity(outputs, genome, observations)
    assert set(found.keys(True, True)) == set(genome.keys(True, True))
    of_rows = torch.vmap(outputs, in_dims=(None, 0))
    rng = torch.Generator().manual_seed(1)
    for key in genome.keys(True, True):
        flat = genome[key].numel()
        for place in torch.randint(flat, (2,), generator=rng).tolist():
            values = []
            for step in (1e-6, -1e-6):
                moved = genome.clone()
                moved[key].view(-1)[place] += step
                values.append(of_rows(moved, observations).detach().numpy())
            slopes = (values[0] - values[1]) / 2e-6
            expected = np.linalg.norm(np.abs(slopes).mean(axis=0))
            assert float(found[key].view(-1)[place]) == pytest.approx(expected, abs=1e-6)


def test_outputs_are_the_values_that_the_actor_acts_on(actor_of):
    for kind, key in (("tanh_normal", "loc"), ("q_value", "action_value")):
        actor = actor_of(kind)
        observation = torch.randn(3)
        row = actor(TensorDict(observation=observation, batch_size=[]))
        found = outputs_of(actor)(genome_of(actor), observation)
        assert torch.allclose(found, row[key], atol=1e-6)
    actor = actor_of("distributional")
    row = actor(TensorDict(observation=torch.ones(3), batch_size=[]))
    means = (row["action_value"].exp() * actor.support[:, None]).sum(0)
    found = outputs_of(actor)(genome_of(actor), torch.ones(3))
    assert torch.allclose(found, means, atol=1e-5)


def test_changes_of_sensitive_weights_shrink_and_those_of_others_grow():
    changes = TensorDict(
        a=torch.full((4, 2), 0.5), b=torch.full((4, 3), 0.5), batch_size=[4]
    )
    sensitivity = TensorDict(a=torch.tensor([4.0, 0.02]), b=torch.tensor([1.0, 2.0, 2.0]))
    out = divide_by_sensitivity(changes, sensitivity, floor=0.1)
    typical = ((16 + 0.0004 + 1 + 4 + 4) / 5) ** 0.5
    for row in range(4):
        expected = [0.5 * typical / 4.0, 5.0]
        assert torch.allclose(out["a"][row], torch.tensor(expected), atol=1e-5)
        expected = [0.5 * typical / s for s in (1.0, 2.0, 2.0)]
        assert torch.allclose(out["b"][row], torch.tensor(expected), atol=1e-5)


@pytest.mark.parametrize("others", [0.0, 2.0])
def test_weights_that_no_output_depends_on_stay(others):
    changes = TensorDict(a=torch.ones(2, 3), b=torch.ones(2, 1), batch_size=[2])
    sensitivity = TensorDict(a=torch.zeros(3), b=torch.tensor([others]))
    out = divide_by_sensitivity(changes, sensitivity)
    assert (out["a"] == 0.0).all()
    assert bool((out["b"] == 0.0).all()) == (others == 0.0)


@pytest.mark.parametrize("floor", [0.0, -1.0, float("nan")])
def test_a_floor_that_is_not_positive_is_refused(floor):
    changes = TensorDict(a=torch.ones(2, 3), batch_size=[2])
    with pytest.raises(ValueError, match="floor"):
        divide_by_sensitivity(changes, TensorDict(a=torch.ones(3)), floor=floor)


def test_without_observations_it_is_refused(actor_of):
    actor = actor_of("q_value")
    with pytest.raises(ValueError, match="observations"):
        output_sensitivity(outputs_of(actor), genome_of(actor), torch.zeros(0, 3))
