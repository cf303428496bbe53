"""Advantage actor-critic, of TorchRL's loss and advantages."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch.optim import Optimizer
from torchrl.objectives import A2CLoss
from torchrl.objectives.value import GAE

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import Agent, Algorithm, MakeEnv
from gdrl_torchrl.agents.collectors.navigation import make_collector
from gdrl_torchrl.agents.networks import make_value_network
from gdrl_torchrl.agents.ppo.agent import make_ppo_actor
from gdrl_torchrl.agents.settings import NetworkConfig
from gdrl_torchrl.agents.update import Update


@dataclasses.dataclass
class A2CConfig:
    """Settings of A2C (Mnih et al. 2016)."""

    actions: ClassVar[str] = "continuous"

    name: str = "a2c"
    num_worlds: int = 16
    frames_per_batch: int = 256
    learning_rate: float = 1e-3
    gamma: float = 0.99
    lmbda: float = 0.95

    def __post_init__(self) -> None:
        if self.frames_per_batch % self.num_worlds:
            raise ValueError(
                f"algorithm.frames_per_batch={self.frames_per_batch} must be a multiple "
                f"of algorithm.num_worlds={self.num_worlds}"
            )


class A2CLearner:
    """One update per batch.

    Args:
        loss: The loss.
        advantage: Writes what the loss reads into batches ``[W, T]``.
        optimizer: Optimiser of the loss's parameters.
        on_non_finite: As of :class:`~gdrl_torchrl.agents.update.Update`.
    """

    def __init__(
        self, loss: A2CLoss, advantage: GAE, optimizer: Optimizer, on_non_finite: str
    ) -> None:
        self.advantage = advantage
        self.update = Update(loss, optimizer, 1.0, on_non_finite=on_non_finite)
        self.updates = [self.update]

    def learn(self, batch: TensorDictBase) -> None:
        """Learn from a batch ``[W, T]``."""
        self.update(self.advantage(batch).reshape(-1))

    def state_dict(self) -> dict[str, Any]:
        """A counter: all else is the optimiser's and the networks'."""
        return {"num_skipped": self.update.num_skipped}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.update.num_skipped = state_dict["num_skipped"]


def make_a2c_agent(
    task: NavigationTask,
    network: NetworkConfig,
    settings: A2CConfig,
    *,
    make_env: MakeEnv,
    on_non_finite: str = "stop",
    **others: Any,
) -> Agent:
    """Build the agent, with its worlds."""
    actor = make_ppo_actor(task, network, settings)
    critic = make_value_network(
        task.spec.observation_size, num_cells=tuple(network.critic_cells)
    )
    loss = A2CLoss(actor, critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.learning_rate)
    advantage = GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=critic)
    collector = make_collector(
        make_env(settings.num_worlds),
        actor,
        frames_per_batch=settings.frames_per_batch,
        policy_keys=["action_log_prob"],
    )
    return Agent(
        actor,
        A2CLearner(loss, advantage, optimizer, on_non_finite),
        collector,
        loss=loss,
        optimizer=optimizer,
        critic=critic,
    )


ALGORITHM = Algorithm(A2CConfig, make_ppo_actor, make_a2c_agent)
