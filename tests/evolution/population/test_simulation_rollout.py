"""Straight to the simulation: the same scores as through the environment."""

from __future__ import annotations

import threading

import pytest
import torch
from torchrl.data import Categorical
from torchrl.envs import StepCounter, TransformedEnv

import gdrl_tasks
from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.population import blocks
from gdrl_torchrl.evolution.population.blocks import block_shapes
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


@pytest.mark.parametrize("worlds", [132, pytest.param(60, marks=pytest.mark.full)])
@pytest.mark.full
def test_shrinking_blocks_are_whole_batches_of_the_environment(
    worlds, actor_of, population_of
):
    """Straight on the simulation, worlds act in blocks that get fewer."""
    task = gdrl_tasks.make_task("indoor", step_limit=120, num_beams=5)
    actor = actor_of("distributional", 7, Categorical(5))
    population = population_of(actor, 11)
    seeds = torch.arange(12)

    def evaluate(wrap):
        evaluator = PopulationEvaluator(
            actor,
            num_episodes=12,
            create_env_fn=lambda: wrap(NavigationEnv(task, worlds, num_threads=1, seed=0)),
            extra_keys=("path_length", "episode_return"),
        )
        alone = evaluator.evaluate(population, seeds=seeds)
        logged, transitions = evaluator.evaluate_with_transitions(population, seeds=seeds)
        evaluator.close()
        assert (alone == logged).all()
        return alone, transitions

    straight, transitions = evaluate(lambda env: env)
    # Nobody knows what a transform does, so this one is stepped as an environment.
    whole, expected = evaluate(lambda env: TransformedEnv(env, StepCounter()))
    assert straight["steps"].unique().numel() > 20, "episodes end at different times"
    for key in ("steps", "outcomes", "successes", "frames"):
        assert torch.equal(straight[key], whole[key]), key
    for key in ("returns", "fitness", "path_length", "episode_return"):
        assert torch.allclose(straight[key], whole[key], atol=1e-5), key
    expected = expected.exclude("step_count", ("next", "step_count"))
    assert set(transitions.keys(True, True)) == set(expected.keys(True, True))
    for key in expected.keys(True, True):
        if "episode_number" in key:  # idle worlds begin episodes too in an environment
            continue
        one, other = transitions[key], expected[key]
        assert one.dtype == other.dtype, key
        assert torch.allclose(one.double(), other.double(), atol=1e-5), key


def test_any_number_of_threads_gives_the_same_scores_bit_by_bit(
    actor_of, population_of, monkeypatch
):
    monkeypatch.setattr(blocks, "_PART_PRODUCTS", 4_000)
    task = gdrl_tasks.make_task("indoor", step_limit=40, num_beams=5)
    actor = actor_of("q_value", 7, Categorical(5))
    population = population_of(actor, 11)

    def evaluate(threads):
        env = NavigationEnv(task, 132, num_threads=threads, seed=0)
        evaluator = PopulationEvaluator(actor, num_episodes=12, create_env_fn=lambda: env)
        found = evaluator.evaluate(population, seeds=torch.arange(12))
        evaluator.close()
        return found

    one, before = evaluate(1), threading.active_count()
    for threads in (2, 3):
        assert (evaluate(threads) == one).all()
    assert threading.active_count() == before
    weights = sum(value.numel() for value in genome_of(actor).values(True, True))
    assert block_shapes(11, 12, weights)[0].parts > 3
    monkeypatch.undo()
    assert (evaluate(2) == one).all(), "as if there were one part"


def test_torch_has_the_threads_that_it_had(actor_of, population_of, evaluator_for):
    evaluator = evaluator_for(actor_of("tanh_normal"), 6, num_episodes=3)
    population = population_of(actor_of("tanh_normal"), 2)
    seen, bind = [], evaluator.population.bind

    def noting(*args, **kwargs):
        seen.append(torch.get_num_threads())
        return bind(*args, **kwargs)

    evaluator.population.bind = noting
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        evaluator.evaluate(population)
        assert torch.get_num_threads() == 3
        evaluator.population.bind = None
        with pytest.raises(TypeError):
            evaluator.evaluate(population)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert set(seen) == {1}


def test_a_transformed_environment_is_never_bypassed(
    actor_of, population_of, easy_task_for
):
    env = TransformedEnv(
        NavigationEnv(easy_task_for(), 6, num_threads=1, seed=0), StepCounter(5)
    )
    actor = actor_of("tanh_normal")
    evaluator = PopulationEvaluator(actor, num_episodes=3, create_env_fn=lambda: env)
    steps = evaluator.evaluate(population_of(actor, 2))["steps"]
    assert steps.max() == 5, "the transform's limit, not the task's"
    evaluator.close()
