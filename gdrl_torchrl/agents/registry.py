"""Algorithms by name, those of other packages included."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict.nn import TensorDictModuleBase

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import Algorithm
from gdrl_torchrl.agents.ga.agent import make_ga_actor, make_ga_agent
from gdrl_torchrl.agents.ga.settings import GAConfig
from gdrl_torchrl.agents.ppo.agent import make_ppo_actor, make_ppo_agent
from gdrl_torchrl.agents.ppo.settings import PPOConfig
from gdrl_torchrl.agents.rainbow.agent import make_rainbow_actor, make_rainbow_agent
from gdrl_torchrl.agents.rainbow.settings import RainbowConfig
from gdrl_torchrl.agents.settings import NetworkConfig, with_algorithms

ALGORITHMS: dict[str, Algorithm] = {
    "ppo": Algorithm(PPOConfig, make_ppo_actor, make_ppo_agent),
    "rainbow": Algorithm(RainbowConfig, make_rainbow_actor, make_rainbow_agent),
    "ga": Algorithm(GAConfig, make_ga_actor, make_ga_agent),
}
"""Ours; see :func:`algorithms` for those of other packages."""


def algorithms() -> Mapping[str, Algorithm]:
    """Ours, and those of other packages, by name."""
    return with_algorithms(ALGORITHMS)


def make_actor(
    task: NavigationTask, network: NetworkConfig, settings: Any
) -> TensorDictModuleBase:
    """A policy with new weights, of the algorithm that settings are of.

    Raises:
        ValueError: If task and algorithm do not fit.
    """
    return algorithms()[settings.name].make_actor(task, network, settings)
