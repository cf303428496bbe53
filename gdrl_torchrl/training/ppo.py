"""The PPO agent of a run."""

from __future__ import annotations

import warnings

import torch
from torchrl.data import (
    Bounded,
    LazyTensorStorage,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.modules import ProbabilisticActor
from torchrl.trainers.algorithms import PPOTrainer

from gdrl_tasks import NavigationTask
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.modules.actor import make_tanh_normal_actor, make_value_network
from gdrl_torchrl.objectives.ppo import make_ppo_loss
from gdrl_torchrl.training.agent import (
    ACTIVATIONS,
    NO_FRAME_LIMIT,
    Agent,
    check_fit,
    make_training_env,
)
from gdrl_torchrl.training.collect import make_collector


def make_ppo_actor(task: NavigationTask, config: ExperimentConfig) -> ProbabilisticActor:
    """The policy of a run.

    Raises:
        ValueError: If the task's actions are discrete.
    """
    check_fit(task, config)
    size = task.spec.action_size
    return make_tanh_normal_actor(
        task.spec.observation_size,
        Bounded(low=-1.0, high=1.0, shape=torch.Size([size]), dtype=torch.float32),
        num_cells=tuple(config.network.actor_cells),
        activation=ACTIVATIONS[config.network.activation],
        initial_std=config.network.initial_std,
    )


def make_ppo_agent(config: ExperimentConfig, task: NavigationTask) -> Agent:
    """Build the agent, its environment and its trainer."""
    algorithm, network = config.algorithm, config.network
    env = make_training_env(config, task)
    actor = make_ppo_actor(task, config)
    critic = make_value_network(
        task.spec.observation_size,
        num_cells=tuple(network.critic_cells),
        sees_time=network.critic_sees_time,
        activation=ACTIVATIONS[network.activation],
    )
    loss, advantage = make_ppo_loss(actor, critic, algorithm)
    optimizer = torch.optim.Adam(
        loss.parameters(), lr=algorithm.learning_rate, eps=1e-5, fused=True
    )
    collector = make_collector(
        env,
        actor,
        frames_per_batch=algorithm.frames_per_batch,
        policy_keys=["action_log_prob"],
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(algorithm.frames_per_batch),
        sampler=SamplerWithoutReplacement(),
        batch_size=algorithm.minibatch_size,
    )
    with warnings.catch_warnings():
        # TorchRL calls its trainers prototypes, and its own on-policy trainer still
        # registers a stage that it deprecates.
        warnings.simplefilter("ignore")
        trainer = PPOTrainer(
            collector=collector,
            total_frames=NO_FRAME_LIMIT,
            frame_skip=1,
            optim_steps_per_batch=None,  # pyright: ignore[reportArgumentType]
            loss_module=loss,
            optimizer=optimizer,
            num_epochs=algorithm.num_epochs,
            replay_buffer=buffer,
            gae=advantage,
            clip_norm=algorithm.max_grad_norm,
            enable_logging=False,
            auto_log_optim_steps=False,
            progress_bar=False,
        )
    # The order of the next epoch is drawn when the one before it ends.
    parts = {"sampler": buffer.sampler}
    return Agent(
        actor,
        trainer,
        env=env,
        loss=loss,
        optimizer=optimizer,
        collector=collector,
        parts=parts,
        critic=critic,
    )
