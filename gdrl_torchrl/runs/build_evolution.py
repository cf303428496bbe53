"""From a configuration to the hook that holds the population."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import Agent, MakeActor
from gdrl_torchrl.agents.ga.settings import GAConfig
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.envs.make import OnDivergence, make_env
from gdrl_torchrl.evolution.hooks.base import PopulationHook
from gdrl_torchrl.evolution.hooks.contest import (
    Contest,
    CopiesContest,
    FullContest,
    PairedContest,
)
from gdrl_torchrl.evolution.hooks.erl import ErlHook
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.hooks.genetic_algorithm import GeneticAlgorithm
from gdrl_torchrl.evolution.operators.crossover import crossovers
from gdrl_torchrl.evolution.operators.genome import concatenate, genome_of, stack_copies
from gdrl_torchrl.evolution.operators.mutation import mutations, standard_deviation
from gdrl_torchrl.evolution.operators.paired import HalvingPlan
from gdrl_torchrl.evolution.operators.schedule import MutationSchedule
from gdrl_torchrl.evolution.operators.sensitivity import output_sensitivity
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.evolution.population.outputs import outputs_of
from gdrl_torchrl.evolution.settings import ErlConfig, EvolutionConfig

MakeEvaluator = Callable[[Any, int], PopulationEvaluator]
"""An evaluator from what it is told of and the number of members."""

_OTHER_WEIGHTS = 1 << 40
"""Added to a run's seed for a first generation, whose weights are not the agent's."""


def make_population_hook(
    config: ExperimentConfig,
    task: NavigationTask,
    agent: Agent,
    make_actor: MakeActor,
    *,
    on_divergence: OnDivergence = None,
) -> PopulationHook:
    """The hook that a configuration asks for, with an evaluator of its own."""
    evaluator = functools.partial(_evaluator, config, task, agent, on_divergence)
    if isinstance(config.algorithm, GAConfig):
        return _genetic_algorithm(config, task, agent, make_actor, evaluator)
    if isinstance(config.evolution, ErlConfig):
        return _erl(config, task, agent, make_actor, evaluator)
    return _genetic(config, agent, evaluator)


def _genetic(
    config: ExperimentConfig, agent: Agent, make_evaluator: MakeEvaluator
) -> PopulationHook:
    evolution: EvolutionConfig = config.evolution
    on_switch: list[Callable[[], object]] = []
    if agent.follow_switch is not None:
        on_switch.append(functools.partial(agent.follow_switch, evolution.target_tau))
    sensitivity = None
    if evolution.sensitivity:
        sensitivity = functools.partial(output_sensitivity, outputs_of(agent.actor))
    return GeneticHook(
        agent.actor,
        make_evaluator(evolution, 1 + evolution.num_children),
        num_children=evolution.num_children,
        period_episodes=evolution.period_episodes if evolution.enabled else None,
        mutation=mutations()[evolution.mutation],
        std=standard_deviation(evolution.mut_v, evolution.mut_v_is),
        schedule=MutationSchedule(tuple(evolution.rates), tuple(evolution.thresholds)),
        crossover=crossovers()[evolution.crossover],
        num_points=evolution.num_points,
        sensitivity=sensitivity,
        sensitivity_rows=evolution.sensitivity_rows,
        contest=_contest(evolution),
        own_share=evolution.own_share,
        window_episodes=evolution.window_episodes,
        optimizer_on_switch=evolution.optimizer_on_switch,
        critic_on_switch=evolution.critic_on_switch,
        optimizer=agent.optimizer,
        critic=agent.critic,
        on_switch=on_switch,
        share_experience=_sharing(agent, evolution.experience_share),
        share_always=evolution.share_on == "always",
        seed=config.seed,
    )


def _erl(
    config: ExperimentConfig,
    task: NavigationTask,
    agent: Agent,
    make_actor: MakeActor,
    make_evaluator: MakeEvaluator,
) -> PopulationHook:
    evolution: ErlConfig = config.evolution
    return ErlHook(
        agent.actor,
        make_evaluator(evolution, evolution.population_size),
        _first_generation(config, task, make_actor, evolution.population_size),
        num_elites=evolution.num_elites,
        tournament_size=evolution.tournament_size,
        mutation_probability=evolution.mutation_probability,
        sync_period=evolution.sync_period,
        share_experience=_sharing(agent, evolution.experience_share),
        period_episodes=evolution.period_episodes if evolution.enabled else None,
        window_episodes=evolution.window_episodes,
        seed=config.seed,
    )


def _genetic_algorithm(
    config: ExperimentConfig,
    task: NavigationTask,
    agent: Agent,
    make_actor: MakeActor,
    make_evaluator: MakeEvaluator,
) -> PopulationHook:
    algorithm: GAConfig = config.algorithm
    return GeneticAlgorithm(
        agent.actor,
        make_evaluator(algorithm, algorithm.population_size),
        _first_generation(config, task, make_actor, algorithm.population_size),
        num_parents=algorithm.num_parents,
        num_validated=algorithm.num_validated,
        validation_trials=algorithm.validation_trials,
        std=algorithm.mutation_std,
        seed=config.seed,
    )


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


def _contest(evolution: EvolutionConfig) -> Contest:
    if evolution.contest == "full":
        return FullContest(evolution.tie_rule)
    if evolution.contest == "copies":
        return CopiesContest()
    return PairedContest(
        HalvingPlan(
            screening_trials=evolution.screening_trials,
            test_trials=evolution.test_trials,
            num_looks=evolution.num_looks,
            level=evolution.level,
        )
    )


def _first_generation(
    config: ExperimentConfig, task: NavigationTask, make_actor: MakeActor, count: int
) -> TensorDictBase:
    """Genomes of new actors, ``[count]``; the run's own generator is left alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed + _OTHER_WEIGHTS)
        genomes = [genome_of(make_actor(task, config)) for _ in range(count)]
    return concatenate([stack_copies(genome, 1) for genome in genomes])


def _sharing(agent: Agent, share: float) -> Callable[[TensorDictBase], object] | None:
    take = agent.share_experience
    if take is None or share == 0.0:
        return None
    return lambda transitions: take(transitions, share)
