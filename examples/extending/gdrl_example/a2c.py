"""Advantage actor-critic on TorchRL's own trainer."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any, ClassVar

import torch
from torchrl.collectors import Collector
from torchrl.data import (
    LazyTensorStorage,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.objectives import A2CLoss
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms import A2CTrainer

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import (
    NO_FRAME_LIMIT,
    Agent,
    Algorithm,
    MakeEnv,
)
from gdrl_torchrl.agents.networks import make_value_network
from gdrl_torchrl.agents.ppo.agent import make_ppo_actor
from gdrl_torchrl.agents.settings import NetworkConfig


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


def make_a2c_agent(
    task: NavigationTask,
    network: NetworkConfig,
    settings: A2CConfig,
    *,
    make_env: MakeEnv,
    **others: Any,
) -> Agent:
    """Build the agent, its environment and its trainer."""
    env = make_env(settings.num_worlds)
    actor = make_ppo_actor(task, network, settings)
    critic = make_value_network(
        task.spec.observation_size, num_cells=tuple(network.critic_cells)
    )
    loss = A2CLoss(actor, critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.learning_rate)
    collector = Collector(
        env,
        actor,
        frames_per_batch=settings.frames_per_batch,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(settings.frames_per_batch),
        sampler=SamplerWithoutReplacement(),
        batch_size=settings.frames_per_batch,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer = A2CTrainer(
            collector=collector,
            total_frames=NO_FRAME_LIMIT,
            frame_skip=1,
            optim_steps_per_batch=1,
            num_epochs=1,
            loss_module=loss,
            optimizer=optimizer,
            replay_buffer=buffer,
            gae=GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=critic),
            enable_logging=False,
            auto_log_optim_steps=False,
            progress_bar=False,
        )
    return Agent(
        actor,
        trainer,
        env=env,
        loss=loss,
        optimizer=optimizer,
        collector=collector,
        critic=critic,
    )


ALGORITHM = Algorithm(A2CConfig, make_ppo_actor, make_a2c_agent)
