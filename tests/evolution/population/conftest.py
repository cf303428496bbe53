"""Evaluators on an easy task, and policies that do not explore."""

from __future__ import annotations

from functools import partial

import pytest
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_torchrl.envs.make import make_env
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


@pytest.fixture
def evaluator_for(easy_task_for):
    """Makes an evaluator of an actor on an easy task; closed at the end."""
    made = []

    def make(actor, worlds, *, task=None, backend="batch", **options):
        task = task or easy_task_for()
        maker = partial(make_env, task, worlds, backend=backend, num_threads=1)
        made.append(PopulationEvaluator(actor, create_env_fn=maker, **options))
        return made[-1]

    yield make
    for evaluator in made:
        evaluator.close()


@pytest.fixture
def greedy():
    """Policies act as they do when they do not explore."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        yield
