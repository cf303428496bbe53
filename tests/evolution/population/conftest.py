"""Evaluators on an easy task."""

from __future__ import annotations

from functools import partial

import pytest

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
