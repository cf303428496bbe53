"""The actor whose population evolves, and quiet trainers."""

from __future__ import annotations

import warnings

import pytest


@pytest.fixture
def actor(actor_of):
    return actor_of("tanh_normal")


@pytest.fixture
def quiet():
    # TorchRL warns that its trainers are prototypes.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
