"""From a configuration to the objects that train."""

from __future__ import annotations

import dataclasses

from tensordict.nn import TensorDictModuleBase

from gdrl_tasks import NavigationTask
from gdrl_torchrl.config.algorithms import (
    GAConfig,
    PPOConfig,
    RainbowConfig,
    with_algorithms,
)
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.envs.make import OnDivergence
from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.training.agent import Agent, Algorithm
from gdrl_torchrl.training.collect_ahead import AheadCollector
from gdrl_torchrl.training.evolve import make_population_hook
from gdrl_torchrl.training.finite_batches import check_batch
from gdrl_torchrl.training.genetic_algorithm import make_ga_actor, make_ga_agent
from gdrl_torchrl.training.population_hook import PopulationHook
from gdrl_torchrl.training.ppo import make_ppo_actor, make_ppo_agent
from gdrl_torchrl.training.rainbow import make_rainbow_actor, make_rainbow_agent

ALGORITHMS: dict[str, Algorithm] = {
    "ppo": Algorithm(PPOConfig, make_ppo_actor, make_ppo_agent),
    "rainbow": Algorithm(RainbowConfig, make_rainbow_actor, make_rainbow_agent),
    "ga": Algorithm(GAConfig, make_ga_actor, make_ga_agent),
}
"""Ours; see :func:`algorithm_of` for those of other packages."""


def algorithm_of(config: ExperimentConfig) -> Algorithm:
    """The algorithm of a run."""
    return with_algorithms(ALGORITHMS)[config.algorithm.name]


@dataclasses.dataclass
class Training:
    """The objects of one run."""

    task: NavigationTask
    agent: Agent
    genetic: PopulationHook
    """Watches success; evaluates populations unless evolution is disabled."""

    def close(self) -> None:
        """Close the environments."""
        self.genetic.evaluator.close()
        env, collector = self.agent.env, self.agent.collector
        if isinstance(collector, AheadCollector):
            collector.shutdown()
        if env is not None and not env.is_closed:
            env.close()


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
    algorithm = algorithm_of(config)
    agent = algorithm.make_agent(config, task)
    if on_divergence is not None and isinstance(agent.env, NavigationEnv):
        agent.env.simulation.watch(on_divergence)
    if on_divergence is not None and isinstance(agent.collector, AheadCollector):
        agent.collector.watch(on_divergence)
    genetic = make_population_hook(
        config, task, agent, algorithm.make_actor, on_divergence=on_divergence
    )
    agent.trainer.register_op("batch_process", check_batch)
    genetic.register(agent.trainer)
    return Training(task, agent, genetic)


def make_actor(task: NavigationTask, config: ExperimentConfig) -> TensorDictModuleBase:
    """The policy of a run, with new weights.

    Raises:
        ValueError: If task and algorithm do not fit.
    """
    return algorithm_of(config).make_actor(task, config)
