"""Things with a state, and checkpoints of them."""

from __future__ import annotations

import numpy as np
import torch

from gdrl_torchrl.runs.checkpoint import Checkpoints

IDENTITY = {"configuration": "0123abcd", "seed": 0}


class State:
    """Something with a state, which counts how often it was restored."""

    def __init__(self, content=None):
        self.content = content
        self.restored = 0

    def state_dict(self):
        return self.content

    def load_state_dict(self, state_dict):
        self.content = state_dict
        self.restored += 1


def content_of(step):
    generator = np.random.default_rng(step)
    return {
        "step": step,
        "weights": torch.from_numpy(generator.normal(size=200)),
        "nested": {3: [np.arange(5) * step, None, (True, float("nan"), "text")]},
    }


def checkpoints_of(folder, state, identity=IDENTITY):
    return Checkpoints(folder, state, identity, keep=2)


def assert_same(found, expected):
    assert type(found) is type(expected)
    if isinstance(expected, dict):
        assert list(found) == list(expected)
        for key in expected:
            assert_same(found[key], expected[key])
    elif isinstance(expected, (list, tuple)):
        assert len(found) == len(expected)
        for pair in zip(found, expected, strict=True):
            assert_same(*pair)
    elif isinstance(expected, torch.Tensor):
        torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)
    else:
        np.testing.assert_array_equal(found, expected)


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())
