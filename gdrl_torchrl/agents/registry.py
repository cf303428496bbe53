"""Algorithms by name, those of other packages included."""

from __future__ import annotations

from tensordict.nn import TensorDictModuleBase

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import Algorithm
from gdrl_torchrl.agents.ga.agent import make_ga_actor, make_ga_agent
from gdrl_torchrl.agents.ga.settings import GAConfig
from gdrl_torchrl.agents.ppo.agent import make_ppo_actor, make_ppo_agent
from gdrl_torchrl.agents.ppo.settings import PPOConfig
from gdrl_torchrl.agents.rainbow.agent import make_rainbow_actor, make_rainbow_agent
from gdrl_torchrl.agents.rainbow.settings import RainbowConfig
from gdrl_torchrl.config.algorithms import with_algorithms
from gdrl_torchrl.config.schema import ExperimentConfig

ALGORITHMS: dict[str, Algorithm] = {
    "ppo": Algorithm(PPOConfig, make_ppo_actor, make_ppo_agent),
    "rainbow": Algorithm(RainbowConfig, make_rainbow_actor, make_rainbow_agent),
    "ga": Algorithm(GAConfig, make_ga_actor, make_ga_agent),
}
"""Ours; see :func:`algorithm_of` for those of other packages."""


def algorithm_of(config: ExperimentConfig) -> Algorithm:
    """The algorithm of a run."""
    return with_algorithms(ALGORITHMS)[config.algorithm.name]


def make_actor(task: NavigationTask, config: ExperimentConfig) -> TensorDictModuleBase:
    """The policy of a run, with new weights.

    Raises:
        ValueError: If task and algorithm do not fit.
    """
    return algorithm_of(config).make_actor(task, config)
