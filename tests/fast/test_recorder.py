"""Noted operations against the functions that ran them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gdrl_torchrl.fast.recorder import Recorder

OPERATIONS = {
    "product": lambda x, y: x @ y,
    "sum of both": lambda x, y: x + y,
    "rows turned round": lambda x, y: x.flip(0) - y,
    "chosen rows": lambda x, y: x[(y[:, 0] > 0).long()],
    "masked": lambda x, y: torch.where(y > 0, x, -y),
    "softmax": lambda x, y: x.softmax(-1) * y.logsumexp(-1, keepdim=True),
    "halves": lambda x, y: torch.cat([*x.split(2), *y.chunk(2)])[::2],
    "largest": lambda x, y: torch.stack([x.max(dim=0)[0], *y.unbind(0)])[:4],
    "written in place": lambda x, y: x.clone().mul_(2.0).add_(y),
    "a view that is written": lambda x, y: write_corner(x.clone(), y),
    "scattered": lambda x, y: torch.zeros_like(x).scatter_add(1, x.argsort(1), y),
    "by member": lambda x, y: torch.vmap(torch.outer)(x, y).sum(-1),
    "gradient": lambda x, y: gradient(lambda z: (z.tanh() @ y).square().sum(), x),
    "gradient through a softmax": lambda x, y: gradient(
        lambda z: (z.log_softmax(-1) * y).sum(), x
    ),
    "vectorised gradient": lambda x, y: torch.func.vmap(
        torch.func.grad(lambda a, b: (a.sigmoid() * b).prod())
    )(x, y),
    "detached": lambda x, y: x.detach() + y.data,
}
"""Functions of two matrices ``[4, 4]`` that give one."""


def write_corner(x, y):
    x[:2, :2] += y[2:, 2:]
    return x


def gradient(function, x):
    with torch.enable_grad():
        leaf = x.detach().requires_grad_()
        return torch.autograd.grad(function(leaf), leaf)[0]


def matrices(count, seed):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(4, 4, generator=generator) for _ in range(count)]


@given(
    steps=st.lists(
        st.tuples(
            st.sampled_from(sorted(OPERATIONS)), st.integers(0, 99), st.integers(0, 99)
        ),
        min_size=1,
        max_size=8,
    ),
    seed=st.integers(0, 1000),
)
def test_what_is_noted_gives_the_functions_numbers_for_other_tensors(steps, seed):
    elsewhere = matrices(1, seed=1)

    def program(tensors):
        known = [*tensors, *elsewhere]
        for name, one, other in steps:
            pair = known[one % len(known)], known[other % len(known)]
            known.append(OPERATIONS[name](*pair))
        return known[3:]

    tensors = matrices(2, seed=2)
    with Recorder(tensors) as recorder:
        outputs = program(tensors)
    whole = recorder.whole(outputs)
    others = matrices(2, seed=seed)
    found, expected = whole(*others), program(others)
    for mine, its in zip(found, expected, strict=True):
        assert torch.equal(mine.nan_to_num(), its.nan_to_num())


def test_tensors_from_elsewhere_are_read_when_the_graph_is_run():
    elsewhere = torch.tensor([1.0, 2.0])
    tensors = [torch.ones(2)]
    with Recorder(tensors) as recorder:
        outputs = [tensors[0] * elsewhere]
    elsewhere.fill_(5.0)
    assert recorder.whole(outputs)(torch.ones(2))[0].tolist() == [5.0, 5.0]


def test_numbers_that_depend_on_nothing_may_be_looked_at():
    tensors = [torch.ones(2)]
    with Recorder(tensors) as recorder:
        bounds = torch.tensor([1.0, 3.0])
        outputs = [tensors[0] * float((bounds[1] - bounds[0]).clone())]
    assert recorder.whole(outputs)(torch.full((2,), 3.0))[0].tolist() == [6.0, 6.0]


def written(x):
    memory = torch.zeros(2)
    view = memory[0]
    memory.add_(x)
    return view.item()


LOOKS = {
    "a number": lambda x: x[0].item(),
    "whether one is": lambda x: bool(x.any()),
    "whether they are equal": lambda x: torch.equal(x, torch.zeros(2)),
    "a draw": lambda x: torch.rand(2)[0].item(),
    "a draw of other tensors": lambda x: torch.bernoulli(torch.full((2,), 0.5)).tolist(),
    "memory that was written": written,
    "a list": lambda x: x.tolist(),
    "NumPy's array": lambda x: torch.from_numpy(2 * x.numpy()),
    "NumPy's function": lambda x: torch.as_tensor(np.tanh(x)),
    "another library's array": lambda x: torch.from_numpy(np.from_dlpack(x)),
    "one of many": lambda x: torch.cat([torch.zeros(2), x])[0].item(),
}


@pytest.mark.parametrize("kind", LOOKS)
def test_looks_at_numbers_that_may_change_are_refused(kind):
    tensors = [torch.ones(2)]
    with pytest.raises(ValueError, match="looks at numbers"), Recorder(tensors):
        LOOKS[kind](tensors[0])
