"""Our hook among TorchRL's configurations, so that a trainer's yaml file can name it."""

from __future__ import annotations

import dataclasses
import functools
import typing
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

# Importing it stores TorchRL's own configurations.
from torchrl.trainers.algorithms.configs.hooks import HookConfig

from gdrl_torchrl.evolution.hooks.attach import NOT_ATTACHED, AttachedGeneticHook
from gdrl_torchrl.evolution.settings import EvolutionConfig


@dataclasses.dataclass
class _AttachedConfig(HookConfig):
    """What an attached hook has beside the settings of every genetic hook."""

    create_env_fn: Any = MISSING
    max_steps: int | None = None
    fitness: str = "return"
    target_tau: float = 1.0
    seed: int = 0
    on_evaluation: list[Any] = dataclasses.field(default_factory=list)
    _target_: str = f"{AttachedGeneticHook.__module__}.{AttachedGeneticHook.__name__}"


def _settings() -> list[tuple[str, Any, Any]]:
    """The other settings: name, type and default."""
    types = typing.get_type_hints(EvolutionConfig)
    own = {field.name for field in dataclasses.fields(_AttachedConfig)}
    return [
        (
            field.name,
            types[field.name],
            field.default
            if field.default is not dataclasses.MISSING
            else dataclasses.field(default_factory=field.default_factory),
        )
        for field in dataclasses.fields(EvolutionConfig)
        if field.name not in own and field.name not in NOT_ATTACHED
    ]


GeneticHookConfig = dataclasses.make_dataclass(
    "GeneticHookConfig", _settings(), bases=(_AttachedConfig,)
)
"""Configuration of :class:`~gdrl_torchrl.evolution.hooks.attach.AttachedGeneticHook`.

Its fields are that class's arguments. ``create_env_fn`` must be given: the configuration
of an environment, with ``_partial_: true`` or without.

Examples:
    >>> from hydra.utils import instantiate
    >>> make_env = {"_target_": "torchrl.envs.GymEnv", "env_name": "CartPole-v1"}
    >>> config = GeneticHookConfig(create_env_fn=make_env | {"_partial_": True})
    >>> type(instantiate(config)).__name__
    'AttachedGeneticHook'
"""


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
