"""Our hook among TorchRL's configurations, so that a trainer's yaml file can name it."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

# Importing it stores TorchRL's own configurations.
from torchrl.trainers.algorithms.configs.hooks import HookConfig


@dataclasses.dataclass
class GeneticHookConfig(HookConfig):
    """Configuration of :class:`~gdrl_torchrl.evolution.hooks.attach.AttachedGeneticHook`.

    Its fields are that class's arguments. ``create_env_fn`` must be given: the
    configuration of an environment, with ``_partial_: true`` or without.

    Examples:
        >>> from hydra.utils import instantiate
        >>> make_env = {"_target_": "torchrl.envs.GymEnv", "env_name": "CartPole-v1"}
        >>> config = GeneticHookConfig(create_env_fn=make_env | {"_partial_": True})
        >>> type(instantiate(config)).__name__
        'AttachedGeneticHook'
    """

    create_env_fn: Any = MISSING
    num_children: int = 10
    period_episodes: int = 50
    num_trials: int = 10
    max_steps: int | None = None
    fitness: str = "return"
    mutation: str = "bernoulli"
    std: float = 0.1
    rates: list[float] = dataclasses.field(default_factory=lambda: [0.75, 0.4, 0.1])
    thresholds: list[float] = dataclasses.field(default_factory=lambda: [0.4, 0.8])
    window_episodes: int = 100
    tie_rule: str = "return_then_parent"
    own_share: float = 0.0
    target_tau: float = 1.0
    seed: int = 0
    on_evaluation: list[Any] = dataclasses.field(default_factory=list)
    _target_: str = "gdrl_torchrl.evolution.hooks.attach.AttachedGeneticHook"


@functools.cache
def register_torchrl_configs() -> None:
    """Store our hook in Hydra's ConfigStore, as ``genetic`` of TorchRL's group ``hook``.

    Examples:
        >>> register_torchrl_configs()
        >>> register_torchrl_configs()  # nothing more happens
        >>> "genetic.yaml" in ConfigStore.instance().list("hook")
        True
    """
    ConfigStore.instance().store(
        group="hook", name="genetic", node=GeneticHookConfig, provider="gdrl_torchrl"
    )
