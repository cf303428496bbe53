"""What an algorithm contributes to a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.objectives.common import LossModule

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.collectors.ahead import AheadCollector
from gdrl_torchrl.agents.settings import NetworkConfig
from gdrl_torchrl.agents.update import Update

MakeActor = Callable[[NavigationTask, NetworkConfig, Any], TensorDictModuleBase]
"""A policy of a task, with networks and an algorithm's settings."""
MakeEnv = Callable[[int], EnvBase]
"""An environment of so many worlds, for a collector to step."""
ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}
NO_FRAME_LIMIT = 1 << 62
"""Budgets end training, not the trainer's own limit."""


class HasState(Protocol):
    """A part whose state belongs into a checkpoint."""

    def state_dict(self) -> dict[str, Any]:
        """State as nested dicts of tensors and plain values."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        ...


class TrainsInSteps(Protocol):
    """What a run asks of a trainer; TorchRL's are such."""

    collected_frames: int
    """Environment steps of the agent."""

    def register_op(self, dest: Any, op: Callable, **kwargs: Any) -> None:
        """Call ``op`` at a stage of every step."""
        ...

    def register_module(self, module_name: str, module: Any) -> None:
        """Note a part by name."""
        ...

    def request_stop(self) -> None:
        """End training after this step."""
        ...

    def train(self) -> None:
        """Train until asked to stop."""
        ...


@dataclasses.dataclass
class Agent:
    """A policy and everything that trains it."""

    actor: TensorDictModuleBase
    trainer: TrainsInSteps
    env: EnvBase | None = None
    """What the collector steps, if there is one."""
    loss: LossModule | None = None
    optimizer: torch.optim.Optimizer | None = None
    collector: Collector | AheadCollector | None = None
    parts: Mapping[str, HasState] = dataclasses.field(default_factory=dict)
    """Further state of the algorithm, by name."""
    updates: Sequence[Update] = ()
    """What counts the updates that were skipped."""
    critic: nn.Module | None = None
    """What ``evolution.critic_on_switch`` is about."""
    follow_switch: Callable[[float], object] | None = None
    """Moves the target network towards the agent's by a share ``tau``."""
    share_experience: Callable[[TensorDictBase, float], object] | None = None
    """Takes a share of whole episodes of other policies, ``[T]``, into the buffer."""


@dataclasses.dataclass(frozen=True)
class Algorithm:
    """An algorithm: what it can be told, and what it makes of that.

    A package offers one of these as an entry point in the group ``gdrl.algorithms``.
    """

    config: type
    """A dataclass with a field ``name`` and a class variable ``actions``: the kind that
    it needs, ``discrete``, ``continuous`` or ``any``."""
    make_actor: MakeActor
    make_agent: Callable[..., Agent]
    """``(task, network, settings, *, make_env, seed, on_non_finite)``: ``make_env`` is a
    :data:`MakeEnv`, ``on_non_finite`` as of
    :class:`~gdrl_torchrl.agents.update.Update`."""
