"""What an algorithm contributes to a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase
from torchrl.objectives.common import LossModule

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.collectors.collects import Collects
from gdrl_torchrl.agents.settings import NetworkConfig
from gdrl_torchrl.agents.update import Update

MakeActor = Callable[[NavigationTask, NetworkConfig, Any], TensorDictModuleBase]
"""A policy of a task, with networks and an algorithm's settings."""
MakeEnv = Callable[[int], EnvBase]
"""An environment of so many worlds, for a collector to step."""
ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}


class HasState(Protocol):
    """A part whose state belongs into a checkpoint."""

    def state_dict(self) -> dict[str, Any]:
        """State as nested dicts of tensors and plain values."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        ...


class Learner(HasState, Protocol):
    """Learns from batches."""

    @property
    def updates(self) -> Sequence[Update]:
        """What makes its updates, counts those that were skipped and keeps their means."""
        ...

    def learn(self, batch: TensorDictBase) -> None:
        """Learn from a batch ``[W, T]`` that was just collected.

        Raises:
            NonFiniteUpdateError: If something in an update is not finite.
        """
        ...


@dataclasses.dataclass
class Agent:
    """A policy and what trains it; one without a learner is trained by evolution alone."""

    actor: TensorDictModuleBase
    learner: Learner | None = None
    collector: Collects | None = None
    """Steps the agent's worlds."""
    loss: LossModule | None = None
    optimizer: torch.optim.Optimizer | None = None
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
