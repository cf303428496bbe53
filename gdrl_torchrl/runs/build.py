"""From a configuration to the objects that train."""

from __future__ import annotations

import dataclasses

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import Agent
from gdrl_torchrl.agents.collectors.finite_batches import check_batch
from gdrl_torchrl.agents.loop import TrainingLoop
from gdrl_torchrl.agents.registry import algorithms
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.envs.make import OnDivergence, make_env
from gdrl_torchrl.evolution.hooks.base import Evolution
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.runs.build_evolution import make_evolution


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
