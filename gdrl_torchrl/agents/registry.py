"""Algorithms by name: ours, and those that other packages offer as entry points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from gdrl_torchrl.agents.ga.settings import GAConfig
from gdrl_torchrl.agents.ppo.settings import PPOConfig
from gdrl_torchrl.agents.rainbow.settings import RainbowConfig
from gdrl_torchrl.plugins import Offers, with_plugins

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModuleBase

    from gdrl_tasks import NavigationTask
    from gdrl_torchrl.agents.base import Algorithm
    from gdrl_torchrl.agents.settings import NetworkConfig

ALGORITHMS: dict[str, type] = {"ppo": PPOConfig, "rainbow": RainbowConfig, "ga": GAConfig}
"""The dataclass of each algorithm of ours."""


def algorithm_configs() -> Offers:
    """The dataclass of each algorithm, those of other packages included.

    Examples:
        >>> algorithm_configs()["ppo"]().name
        'ppo'
    """
    offers = _with_others(ALGORITHMS)
    others = {n: offer.config for n, offer in offers.items() if n not in ALGORITHMS}
    return Offers(others | ALGORITHMS, offers.broken)


def algorithms() -> Mapping[str, Algorithm]:
    """Ours, and those of other packages, by name."""
    # Imported here because torch takes seconds, and a wrong option is answered before.
    from gdrl_torchrl.agents.base import Algorithm
    from gdrl_torchrl.agents.ga.agent import make_ga_actor, make_ga_agent
    from gdrl_torchrl.agents.ppo.agent import make_ppo_actor, make_ppo_agent
    from gdrl_torchrl.agents.rainbow.agent import make_rainbow_actor, make_rainbow_agent

    return _with_others(
        {
            "ppo": Algorithm(PPOConfig, make_ppo_actor, make_ppo_agent),
            "rainbow": Algorithm(RainbowConfig, make_rainbow_actor, make_rainbow_agent),
            "ga": Algorithm(GAConfig, make_ga_actor, make_ga_agent),
        }
    )


def make_actor(
    task: NavigationTask, network: NetworkConfig, settings: Any
) -> TensorDictModuleBase:
    """A policy with new weights, of the algorithm that settings are of.

    Raises:
        ValueError: If task and algorithm do not fit.
    """
    return algorithms()[settings.name].make_actor(task, network, settings)


def _with_others(own: Mapping[str, Any]) -> Offers:
    needs = ("config", "make_actor", "make_agent")
    return with_plugins(own, "gdrl.algorithms", needs=needs)
