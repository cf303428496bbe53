"""From a configuration to the objects that train, and those that evaluate populations."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import Agent
from gdrl_torchrl.agents.collectors.finite_batches import check_batch
from gdrl_torchrl.agents.ga.settings import GAConfig
from gdrl_torchrl.agents.loop import TrainingLoop
from gdrl_torchrl.agents.registry import algorithms, make_actor
from gdrl_torchrl.config.relations import make_task_of
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
from gdrl_torchrl.evolution.population.rules import exploration_of
from gdrl_torchrl.evolution.race.hook import RaceHook
from gdrl_torchrl.evolution.settings import ErlConfig, EvolutionConfig, RaceConfig

MakeEvaluator = Callable[[Any, int], PopulationEvaluator]
"""An evaluator from settings and the number of episodes that are played at once."""
MakeGeneration = Callable[[int], TensorDictBase]
"""A first generation of so many members."""

_OTHER_WEIGHTS = 1 << 40
"""Added to a run's seed for a first generation, whose weights are not the agent's."""


@dataclasses.dataclass
class Training:
    """The objects of one run."""

    task: NavigationTask
    agent: Agent
    loop: TrainingLoop
    watch: EpisodeWatch
    """Counts the agent's episodes and their success."""
    evolution: Evolution | None
    """Evaluates populations; None for a bare agent."""

    def close(self) -> None:
        """Close the worlds."""
        if self.evolution is not None:
            self.evolution.evaluator.close()
        if self.agent.collector is not None:
            self.agent.collector.shutdown()


def build_training(
    config: ExperimentConfig, *, on_divergence: OnDivergence = None
) -> Training:
    """Build everything that a run trains with; seeds are the configuration's.

    The global torch generator must have been seeded by the caller: initial weights and
    the policy's noise come from it.

    Args:
        config: The configuration.
        on_divergence: Called with every world that diverges, the agent's or one of a
            population's.

    Raises:
        ValueError: If task and algorithm do not fit, or an option is out of range.
    """
    task = make_task_of(config)
    agent = make_agent(task, config)
    if on_divergence is not None and agent.collector is not None:
        agent.collector.watch(on_divergence)
    loop = TrainingLoop(agent.learner, agent.collector)
    loop.register_op("batch_process", check_batch)
    watch = EpisodeWatch(config.evolution.window_episodes)
    watch.register(loop)
    evolution = make_evolution(config, task, agent, watch, on_divergence=on_divergence)
    if evolution is not None:
        evolution.register(loop)
    return Training(task, agent, loop, watch, evolution)


def make_agent(task: NavigationTask, config: ExperimentConfig) -> Agent:
    """The agent of a run.

    Raises:
        ValueError: If task and algorithm do not fit.
    """
    return algorithms()[config.algorithm.name].make_agent(
        task,
        config.network,
        config.algorithm,
        make_env=lambda num_worlds: make_env(
            task,
            num_worlds,
            backend=config.task.backend,
            num_threads=config.simulation.num_threads,
            seed=config.seed,
        ),
        seed=config.seed,
        on_non_finite=config.faults.on_non_finite_update,
    )


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
        make_evaluator(settings, (1 + settings.num_children) * settings.num_trials),
        breeding_of(settings, agent.actor),
        contest_of(settings),
        hand_over_of(
            settings,
            agent.actor,
            optimizer=agent.optimizer,
            critic=agent.critic,
            follow_switch=agent.follow_switch,
            share_experience=_sharing(agent, settings),
        ),
        watch=watch,
        period_episodes=settings.period_episodes,
        success_range=settings.success_range,
        rate_of=settings.rate_of,
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
        make_evaluator(settings, settings.population_size * settings.num_trials),
        make_generation(settings.population_size),
        num_elites=settings.num_elites,
        tournament_size=settings.tournament_size,
        mutation_probability=settings.mutation_probability,
        sync_period=settings.sync_period,
        share_experience=_sharing(agent, settings),
        watch=watch,
        period_episodes=settings.period_episodes,
        seed=config.seed,
    )


def _race(
    config: ExperimentConfig,
    agent: Agent,
    watch: EpisodeWatch,
    make_evaluator: MakeEvaluator,
    make_generation: MakeGeneration,
) -> Evolution:
    settings: RaceConfig = config.evolution
    return RaceHook(
        agent.actor,
        make_evaluator(settings, max(settings.num_members, settings.num_trials)),
        settings,
        optimizer=agent.optimizer,
        watch=watch,
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
        make_evaluator(settings, settings.population_size * settings.num_trials),
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
    RaceConfig: _race,
    GAConfig: _genetic_algorithm,
}
"""By the class of the settings, of an algorithm or of what evolves beside one."""


def _evaluator(
    config: ExperimentConfig,
    task: NavigationTask,
    agent: Agent,
    on_divergence: OnDivergence,
    settings: Any,
    episodes: int,
) -> PopulationEvaluator:
    """An evaluator of ``num_trials`` episodes with an environment of its own."""
    worlds = settings.num_worlds or episodes
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
        exploration_type=exploration_of(getattr(settings, "act", "greedy")),
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


def _sharing(
    agent: Agent, settings: EvolutionConfig | ErlConfig
) -> Callable[[TensorDictBase], object] | None:
    take = agent.share_experience
    if take is None or settings.experience_share == 0.0:
        return None
    share, more = settings.experience_share, settings.updates_for_shared
    return lambda transitions: take(transitions, share, with_updates=more)
