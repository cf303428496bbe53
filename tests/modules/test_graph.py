"""Traced functions against the functions themselves."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gdrl_torchrl.modules.graph import TracedFunction


def tensors(*shapes, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(*shape, generator=generator) for shape in shapes]


def layer(constants, inputs):
    """A linear layer with work that changes nothing, or that needs no inputs."""
    weight, bias = constants
    (x,) = inputs
    weight = weight.transpose(0, 1).expand(3, 2).transpose(0, 1).transpose(0, 1)
    unused = x.exp()
    out = (x.reshape(x.shape) @ weight) * 1 + bias.exp().view(1, 2)
    return [out, out.view(out.shape), unused[:0], bias + 1.0, x]


def test_it_gives_the_functions_numbers_for_other_constants_and_inputs():
    shapes = ((2, 3), (2,)), ((5, 3),)
    traced = TracedFunction(layer, tensors(*shapes[0]), tensors(*shapes[1]))
    for seed in range(5):
        constants = tensors(*shapes[0], seed=seed)
        prepared = traced.prepare(constants)
        for other in (10, 11):
            inputs = tensors(*shapes[1], seed=other)
            expected = layer(constants, inputs)
            found = traced.run(prepared, inputs)
            assert len(found) == len(expected)
            for mine, its in zip(found, expected, strict=True):
                assert torch.equal(mine, its)


def test_only_work_on_the_inputs_is_left():
    traced = TracedFunction(layer, tensors((2, 3), (2,)), tensors((5, 3)))
    # A product, a sum, and the exponential with its slice.
    assert traced.num_operations == 4


@given(factor=st.sampled_from([0, 1, 1.0, 2, -1, 0.5, True]), wide=st.booleans())
def test_only_products_with_one_are_left_out(factor, wide):
    def scale(constants, inputs):
        return [inputs[0] * factor + constants[0]]

    kind = torch.float64 if wide else torch.int64
    constants, inputs = [torch.ones(3)], [torch.arange(3).to(kind)]
    traced = TracedFunction(scale, constants, inputs)
    found = traced.run(traced.prepare(constants), inputs)[0]
    expected = scale(constants, inputs)[0]
    assert torch.equal(found, expected)
    assert found.dtype == expected.dtype


def test_a_function_that_writes_into_its_own_tensors_is_right():
    def accumulate(constants, inputs):
        total = constants[0] * 2.0
        total += inputs[0]
        seen = total.view(-1)
        total *= 3.0
        return [seen, total]

    constants, inputs = tensors((4,)), tensors((4,), seed=1)
    traced = TracedFunction(accumulate, constants, inputs)
    prepared = traced.prepare(constants)
    for _ in range(3):
        expected = accumulate(constants, inputs)
        for mine, its in zip(traced.run(prepared, inputs), expected, strict=True):
            assert torch.equal(mine, its)


def test_random_numbers_are_drawn_at_every_run():
    def noisy(constants, inputs):
        return [inputs[0] + torch.randn_like(constants[0])]

    constants, inputs = tensors((6,)), tensors((6,), seed=1)
    traced = TracedFunction(noisy, constants, inputs)
    prepared = traced.prepare(constants)
    one, other = (traced.run(prepared, inputs)[0] for _ in range(2))
    assert (one != other).all()


def test_conjugates_are_not_taken_for_what_they_share_memory_with():
    def conjugate(constants, inputs):
        return [inputs[0].conj() + constants[0]]

    constants = [torch.zeros(2, dtype=torch.complex64)]
    inputs = [torch.tensor([1 + 2j, 3 - 1j])]
    traced = TracedFunction(conjugate, constants, inputs)
    found = traced.run(traced.prepare(constants), inputs)[0]
    assert torch.equal(found, torch.tensor([1 - 2j, 3 + 1j]))


def test_what_the_function_raises_is_raised():
    def look(constants, inputs):
        raise KeyError("nothing here")

    with pytest.raises(KeyError, match="nothing here"):
        TracedFunction(look, tensors((1,)), tensors((1,)))
