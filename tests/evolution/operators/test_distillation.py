"""Distillation: a policy that does what others did."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from gdrl_torchrl.evolution.operators.distillation import Demonstration, distil

FIRST = TensorDict(weight=torch.zeros(2, 3), bias=torch.zeros(2))


def linear(genomes):
    return lambda x: torch.baddbmm(genomes["bias"][:, None], x, genomes["weight"].mT)


def shown_by(weight, bias, rows=40, seed=0):
    x = torch.randn(rows, 3, generator=torch.Generator().manual_seed(seed))
    return Demonstration(x, x @ weight.T + bias)


def fit(groups, seed=0, **options):
    rng = torch.Generator().manual_seed(seed)
    return distil(linear, FIRST, groups, generator=rng, **options)


WEIGHT, BIAS = torch.tensor([[1.0, -0.5, 0.2], [0.0, 0.3, -1.0]]), torch.tensor([0.1, -0.2])


def test_each_group_is_fitted_by_itself():
    one, other = shown_by(WEIGHT, BIAS), shown_by(-WEIGHT, 2 * BIAS, rows=25, seed=1)
    fitted, errors = fit([[one], [other], [one, one]], num_updates=800)
    for genome, sign, shift in zip(fitted, (1, -1, 1), (1, 2, 1), strict=True):
        torch.testing.assert_close(genome["weight"], sign * WEIGHT, atol=0.02, rtol=0.0)
        torch.testing.assert_close(genome["bias"], shift * BIAS, atol=0.02, rtol=0.0)
    assert errors.max() < 1e-3
    assert (FIRST["weight"] == 0.0).all(), "the first weights are the caller's"
    assert not any(leaf.requires_grad for leaf in fitted.values())


def test_the_error_tells_demonstrations_that_contradict_each_other():
    one, same, other = (
        shown_by(WEIGHT, BIAS, seed=0),
        shown_by(WEIGHT, BIAS, seed=1),
        shown_by(-WEIGHT, BIAS, seed=2),
    )
    _, errors = fit([[one, same], [one, other]])
    assert errors[0] < 0.05 * errors[1]


def test_the_fit_is_that_of_least_squares():
    x = torch.randn(60, 3, generator=torch.Generator().manual_seed(4))
    noise = 0.3 * torch.randn(60, 2, generator=torch.Generator().manual_seed(5))
    y = x @ WEIGHT.T + BIAS + noise
    design = torch.cat([x, torch.ones(60, 1)], dim=1)
    expected = torch.linalg.lstsq(design, y).solution
    fitted, errors = fit([[Demonstration(x, y)]], num_updates=1500, learning_rate=3e-3)
    torch.testing.assert_close(fitted["weight"][0], expected[:3].T, atol=0.05, rtol=0.0)
    residual = (design @ expected - y).square().mean()
    assert errors[0] == pytest.approx(float(residual), rel=0.3)


def test_the_same_generator_gives_the_same_fit_and_another_another():
    groups = [[shown_by(WEIGHT, BIAS)]]
    first, again, other = (fit(groups, seed, num_updates=20)[0] for seed in (0, 0, 1))
    assert (first == again).all()
    assert not (first == other).all()
