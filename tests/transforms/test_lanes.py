"""A population split among environments scores as in one, on threads or in turns."""

from __future__ import annotations

import threading
from functools import partial

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Categorical
from torchrl.envs.utils import ExplorationType

from gdrl_tasks import make_task
from gdrl_torchrl.envs.make import make_env
from gdrl_torchrl.evolution.genome import genome_of, stack_copies
from gdrl_torchrl.transforms.population_evaluator import PopulationEvaluator
from gdrl_torchrl.transforms.population_rollout import PopulationRollout

SEEDS = torch.tensor([11, 12, 13])


@pytest.fixture
def evaluator_for():
    """Makes evaluators with several environments; closed at the end."""
    made = []

    def make(actor, task, worlds, count, **options):
        maker = partial(make_env, task, worlds, num_threads=1)
        evaluator = PopulationEvaluator(
            actor, create_env_fn=maker, num_environments=count, **options
        )
        made.append(evaluator)
        return evaluator

    yield make
    for evaluator in made:
        evaluator.close()


@pytest.fixture
def threads_seen(monkeypatch):
    """Names of the threads that rollouts ran on."""
    seen = []
    run = PopulationRollout.run

    def noted(self, *args):
        seen.append(threading.current_thread().name)
        return run(self, *args)

    monkeypatch.setattr(PopulationRollout, "run", noted)
    return seen


def assert_same(one, other):
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        if "episode_number" in key:  # an environment's own count
            continue
        value = one[key]
        if value.dtype.is_floating_point:
            assert torch.allclose(value, other[key], atol=1e-6), key
        else:
            assert torch.equal(value, other[key]), key


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("worlds", [3, 6, 15])
def test_scores_and_transitions_do_not_depend_on_the_split(
    count, worlds, actor_kind, actor_of, population_of, easy_task_for, evaluator_for
):
    actor, task = actor_of(actor_kind), easy_task_for(actor_kind)
    population = population_of(actor, 5)
    whole, split = (
        evaluator_for(actor, task, size, number, num_episodes=3)
        for size, number in ((15, 1), (worlds, count))
    )
    expected = whole.evaluate_with_transitions(population, seeds=SEEDS)
    found = split.evaluate_with_transitions(population, seeds=SEEDS)
    for one, other in zip(expected, found, strict=True):
        assert_same(one, other)
    assert expected[0]["steps"].unique().numel() > 1


def test_the_indoor_task_is_scored_the_same(population_of, evaluator_for, actor_of):
    task = make_task("indoor", step_limit=60, num_beams=5)
    actor = actor_of("distributional", 7, Categorical(5))
    population = population_of(actor, 4)
    expected, found = (
        evaluator_for(actor, task, worlds, count, num_episodes=3).evaluate(
            population, seeds=SEEDS
        )
        for worlds, count in ((12, 1), (6, 2))
    )
    assert_same(expected, found)


def test_lanes_of_traced_greedy_actors_have_threads(
    threads_seen, actor_of, population_of, easy_task_for, evaluator_for
):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(actor, easy_task_for(), 6, 2, num_episodes=3)
    evaluator.evaluate(population_of(actor, 4), seeds=SEEDS)
    assert len(set(threads_seen)) == 2
    assert any("gdrl-lane" in name for name in threads_seen)


class Shaken(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(3, 2)

    def forward(self, observation):
        return self.layer(observation) + torch.randn(observation.shape[0], 2)


def test_what_is_random_takes_turns(
    threads_seen, actor_of, population_of, easy_task_for, evaluator_for
):
    actor = TensorDictModule(Shaken(), ["observation"], ["action"])
    evaluator = evaluator_for(actor, easy_task_for(), 6, 2, num_episodes=3)
    evaluator.evaluate(stack_copies(genome_of(actor), 4), seeds=SEEDS)
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(
        actor,
        easy_task_for(),
        6,
        2,
        num_episodes=3,
        exploration_type=ExplorationType.RANDOM,
    )
    evaluator.evaluate(population_of(actor, 4), seeds=SEEDS)
    assert set(threads_seen) == {"MainThread"}
    assert len(threads_seen) == 4


def test_a_lane_without_work_is_left_out(
    threads_seen, actor_of, population_of, easy_task_for, evaluator_for
):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(actor, easy_task_for(), 3, 3, num_episodes=3)
    result = evaluator.evaluate(population_of(actor, 1), seeds=SEEDS)
    assert result["steps"].shape == (1, 3)
    assert threads_seen == ["MainThread"]


def test_an_error_in_a_thread_reaches_the_caller(
    monkeypatch, actor_of, population_of, easy_task_for, evaluator_for
):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(actor, easy_task_for(), 6, 2, num_episodes=3)
    run = PopulationRollout.run

    def failing(self, *args):
        if "gdrl-lane" in threading.current_thread().name:
            raise RuntimeError("the sea is gone")
        return run(self, *args)

    monkeypatch.setattr(PopulationRollout, "run", failing)
    with pytest.raises(RuntimeError, match="the sea is gone"):
        evaluator.evaluate(population_of(actor, 4), seeds=SEEDS)


@pytest.mark.parametrize("count", [0, -1])
def test_a_bad_number_of_environments_is_named(count, actor_of):
    with pytest.raises(ValueError, match=f"num_environments={count}"):
        PopulationEvaluator(actor_of("tanh_normal"), num_environments=count)


def test_several_environments_must_be_made(actor_of):
    with pytest.raises(ValueError, match="num_environments=2 needs create_env_fn"):
        PopulationEvaluator(actor_of("tanh_normal"), num_environments=2)
