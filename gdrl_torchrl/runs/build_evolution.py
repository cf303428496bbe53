"""From a configuration to what evaluates populations."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import Agent
from gdrl_torchrl.agents.ga.settings import GAConfig
from gdrl_torchrl.agents.registry import make_actor
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.envs.make import OnDivergence, make_env
from gdrl_torchrl.evolution.hooks.base import Evolution
from gdrl_torchrl.evolution.hooks.breeding import breeding_of
from gdrl_torchrl.evolution.hooks.contest import contest_of
from gdrl_torchrl.evolution.hooks.erl import ErlHook
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.hooks.genetic_algorithm import GeneticAlgorithm
from gdrl_torchrl.evolution.hooks.hand_over import hand_over_of
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.evolution.operators.genome import concatenate, genome_of, stack_copies
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.evolution.settings import ErlConfig, EvolutionConfig

MakeEvaluator = Callable[[Any, int], PopulationEvaluator]
"""An evaluator from settings and the number of members."""
MakeGeneration = Callable[[int], TensorDictBase]
"""A first generation of so many members."""

_OTHER_WEIGHTS = 1 << 40
"""Added to a run's seed for a first generation, whose weights are not the agent's."""


def make_evolution(
    config: ExperimentConfig,
    task: NavigationTask,
    agent: Agent,
    watch: EpisodeWatch,
    *,
    on_divergence: OnDivergence = None,
) -> Evolution | None:
    """What evaluates populations in a run, with an evaluator of its own.

    Returns:
        None for a bare agent.
    """
    make = _MAKERS.get(type(config.algorithm))
    if make is None and config.evolution.enabled:
        make = _MAKERS[type(config.evolution)]
    if make is None:
        return None
    evaluator = functools.partial(_evaluator, config, task, agent, on_divergence)
    first = functools.partial(_first_generation, config, task)
    return make(config, agent, watch, evaluator, first)


def _genetic(
    config: ExperimentConfig,
    agent: Agent,
    watch: EpisodeWatch,
    make_evaluator: MakeEvaluator,
    make_generation: MakeGeneration,
) -> Evolution:
    settings: EvolutionConfig = config.evolution
    return GeneticHook(
        agent.actor,
        make_evaluator(settings, 1 + settings.num_children),
        breeding_of(settings, agent.actor),
        contest_of(settings),
        hand_over_of(
            settings,
            agent.actor,
            optimizer=agent.optimizer,
            critic=agent.critic,
            follow_switch=agent.follow_switch,
            share_experience=_sharing(agent, settings.experience_share),
        ),
        watch=watch,
        period_episodes=settings.period_episodes,
        seed=config.seed,
    )


def _erl(
    config: ExperimentConfig,
    agent: Agent,
    watch: EpisodeWatch,
    make_evaluator: MakeEvaluator,
    make_generation: MakeGeneration,
) -> Evolution:
    settings: ErlConfig = config.evolution
    return ErlHook(
        agent.actor,
        make_evaluator(settings, settings.population_size),
        make_generation(settings.population_size),
        num_elites=settings.num_elites,
        tournament_size=settings.tournament_size,
        mutation_probability=settings.mutation_probability,
        sync_period=settings.sync_period,
        share_experience=_sharing(agent, settings.experience_share),
        watch=watch,
        period_episodes=settings.period_episodes,
        seed=config.seed,
    )


def _genetic_algorithm(
    config: ExperimentConfig,
    agent: Agent,
    watch: EpisodeWatch,
    make_evaluator: MakeEvaluator,
    make_generation: MakeGeneration,
) -> Evolution:
    settings: GAConfig = config.algorithm
    return GeneticAlgorithm(
        make_evaluator(settings, settings.population_size),
        make_generation(settings.population_size),
        num_parents=settings.num_parents,
        num_validated=settings.num_validated,
        validation_trials=settings.validation_trials,
        std=settings.mutation_std,
        watch=watch,
        seed=config.seed,
    )


_MAKERS: dict[type, Callable[..., Evolution]] = {
    EvolutionConfig: _genetic,
    ErlConfig: _erl,
    GAConfig: _genetic_algorithm,
}
"""By the class of the settings, of an algorithm or of what evolves beside one."""


def _evaluator(
    config: ExperimentConfig,
    task: NavigationTask,
    agent: Agent,
    on_divergence: OnDivergence,
    settings: Any,
    members: int,
) -> PopulationEvaluator:
    """An evaluator of ``num_trials`` episodes with an environment of its own."""
    worlds = settings.num_worlds or members * settings.num_trials
    return PopulationEvaluator(
        agent.actor,
        num_episodes=settings.num_trials,
        create_env_fn=lambda: make_env(
            task,
            worlds,
            backend=config.task.backend,
            num_threads=config.simulation.num_threads,
            seed=config.seed,
            on_divergence=on_divergence,
        ),
        fitness=settings.fitness,
        seed=config.seed,
    )


def _first_generation(
    config: ExperimentConfig, task: NavigationTask, count: int
) -> TensorDictBase:
    """Genomes of new actors, ``[count]``; the run's own generator is left alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed + _OTHER_WEIGHTS)
        genomes = [
            genome_of(make_actor(task, config.network, config.algorithm))
            for _ in range(count)
        ]
    return concatenate([stack_copies(genome, 1) for genome in genomes])


def _sharing(agent: Agent, share: float) -> Callable[[TensorDictBase], object] | None:
    take = agent.share_experience
    if take is None or share == 0.0:
        return None
    return lambda transitions: take(transitions, share)
