"""Traced functions against the functions themselves."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gdrl_torchrl.fast.graph import TracedFunction, trace


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


def test_what_is_computed_twice_is_computed_once():
    def twice(constants, inputs):
        return [inputs[0].exp() + inputs[0].exp(), inputs[0].exp() - 1.0]

    inputs = tensors((3,))
    traced = TracedFunction(twice, [], inputs)
    assert traced.num_operations == 3
    for one, other in zip(traced.run([], inputs), twice([], inputs), strict=True):
        assert torch.equal(one, other)


def test_a_bound_function_has_the_constants_as_they_were_and_no_history():
    weight = torch.nn.Parameter(torch.ones(3))

    def scaled(constants, inputs):
        return [inputs[0] * constants[0].exp()]

    traced = TracedFunction(scaled, [weight], tensors((3,)))
    (x,) = tensors((3,), seed=1)
    bound = traced.bind([weight])
    weight.data = torch.zeros(3)
    [found] = bound(x)
    assert torch.equal(found, x * torch.ones(3).exp())
    assert not found.requires_grad
    assert torch.equal(traced.bind([weight])(x)[0], x)


def test_equal_draws_stay_two():
    def draws(constants, inputs):
        return [torch.rand_like(inputs[0]) - torch.rand_like(inputs[0])]

    traced = TracedFunction(draws, [], tensors((50,)))
    assert (traced.run([], tensors((50,)))[0] != 0.0).all()


def test_draws_that_depend_on_nothing_are_new_at_every_run():
    def explore(constants, inputs):
        first, second = inputs[0].split(2, dim=-1)
        chosen = torch.rand(3) < constants[0]
        return [
            torch.where(chosen, torch.randint(0, 5, (3,)), first.sum(-1) + second[:, 0])
        ]

    constants, inputs = [torch.tensor(0.5)], tensors((3, 3), seed=1)
    traced = trace(explore, constants, inputs)
    prepared = traced.prepare(constants)
    torch.manual_seed(0)
    found = [traced.run(prepared, inputs)[0] for _ in range(20)]
    torch.manual_seed(0)
    expected = [explore(constants, inputs)[0] for _ in range(20)]
    assert torch.equal(torch.stack(found), torch.stack(expected))
    assert len({tuple(row.tolist()) for row in found}) > 10


def noise(constants, inputs):
    """Numbers that are drawn in place, into memory that is new."""
    return [inputs[0] + constants[0].exp() * torch.empty(3).normal_(), constants[0].exp()]


def test_what_fills_new_memory_keeps_nothing_from_being_left_out():
    (scale,), (x,) = tensors((3,)), tensors((3,), seed=1)
    traced = TracedFunction(noise, [scale], [x])
    # Memory, the draw, a product and a sum.
    assert traced.num_operations == 4
    prepared = traced.prepare([scale])
    torch.manual_seed(0)
    found = [traced.run(prepared, [x])[0] for _ in range(2)]
    torch.manual_seed(0)
    expected = [noise([scale], [x])[0] for _ in range(2)]
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)


def test_new_memory_that_happens_to_be_equal_makes_no_difference(monkeypatch):
    monkeypatch.setattr("gdrl_torchrl.fast.graph._are_equal", lambda one, other: True)
    traced = TracedFunction(noise, tensors((3,)), tensors((3,)))
    assert traced.num_operations == 4


def test_tracing_finds_random_functions_equal_and_draws_nothing():
    torch.manual_seed(0)
    before = torch.get_rng_state()
    assert trace(noise, tensors((3,)), tensors((3,))) is not None
    assert torch.equal(torch.get_rng_state(), before)


def test_other_randomness_and_looks_at_numbers_are_not_traced():
    generator = torch.Generator().manual_seed(0)

    def private(constants, inputs):
        return [inputs[0] + torch.rand(3, generator=generator)]

    def looking(constants, inputs):
        return [inputs[0] if inputs[0].sum() > 0 else -inputs[0]]

    assert trace(private, [], tensors((3,))) is None
    assert trace(looking, [], tensors((3,))) is None


def test_gradients_that_a_function_takes_are_part_of_its_graph():
    def slope(constants, inputs):
        with torch.enable_grad():
            x = inputs[0].detach().requires_grad_()
            return list(torch.autograd.grad((constants[0] * x.sin()).sum(), [x]))

    constants, inputs = tensors((3,)), tensors((3,), seed=1)
    traced = trace(slope, constants, inputs)
    found = traced.run(traced.prepare(constants), inputs)[0]
    assert torch.equal(found, constants[0] * inputs[0].cos())
