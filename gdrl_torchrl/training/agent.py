"""What an algorithm contributes to a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.objectives.common import LossModule
from torchrl.trainers import Trainer

from gdrl_tasks import NavigationTask
from gdrl_torchrl.config.schema import ExperimentConfig

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


@dataclasses.dataclass
class Agent:
    """A policy and everything that trains it."""

    actor: TensorDictModuleBase
    loss: LossModule
    optimizer: torch.optim.Optimizer
    collector: Collector
    trainer: Trainer
    parts: Mapping[str, HasState]
    """Further state of the algorithm, by name."""
    critic: nn.Module | None = None
    """What ``evolution.critic_on_switch`` is about."""
    follow_switch: Callable[[float], object] | None = None
    """Moves the target network towards the agent's by a share ``tau``."""
    share_experience: Callable[[TensorDictBase, float], object] | None = None
    """Takes a share of whole episodes of other policies, ``[T]``, into the buffer."""


def check_actions(task: NavigationTask, config: ExperimentConfig) -> None:
    """Raise ValueError unless the task has the kind of actions the algorithm needs."""
    needs_discrete = config.algorithm.name == "rainbow"
    if task.spec.is_discrete != needs_discrete:
        kind = "discrete" if needs_discrete else "continuous"
        raise ValueError(
            f"task.actions={config.task.actions!r}: algorithm.name="
            f"{config.algorithm.name!r} needs task.actions={kind}"
        )
