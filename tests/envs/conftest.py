"""Environments that are closed at the end."""

from __future__ import annotations

import pytest

from gdrl_tasks import make_task
from gdrl_torchrl.envs.make import make_env
from tests.envs.steps import WAVES


@pytest.fixture
def env_of():
    """Makes environments, and closes them at the end."""
    made = []

    def make(worlds=4, *, backend="batch", seed=0, **options):
        task = make_task("water", **WAVES | options)
        made.append(make_env(task, worlds, backend=backend, num_threads=1, seed=seed))
        return made[-1]

    yield make
    for env in made:
        env.close(raise_if_closed=False)
