"""From a configuration to the objects that train."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import torch
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import (
    Bounded,
    LazyTensorStorage,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor
from torchrl.objectives.common import LossModule
from torchrl.trainers import Trainer
from torchrl.trainers.algorithms import PPOTrainer

from gdrl_tasks import NavigationTask
from gdrl_torchrl.config.schema import EvolutionConfig, ExperimentConfig, NetworkConfig
from gdrl_torchrl.config.task import make_task_from_config
from gdrl_torchrl.envs.make import make_env
from gdrl_torchrl.evolution.mutation import MUTATIONS, standard_deviation
from gdrl_torchrl.evolution.schedule import MutationSchedule
from gdrl_torchrl.modules.actor import make_tanh_normal_actor, make_value_network
from gdrl_torchrl.objectives.ppo import make_ppo_loss
from gdrl_torchrl.training.genetic import GeneticHook
from gdrl_torchrl.transforms.population_evaluator import PopulationEvaluator

ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}
_NO_FRAME_LIMIT = 1 << 62
"""Budgets end training, not the trainer's own limit."""


@dataclasses.dataclass
class Training:
    """The objects of one run."""

    task: NavigationTask
    env: EnvBase
    actor: ProbabilisticActor
    loss: LossModule
    optimizer: torch.optim.Optimizer
    collector: Collector
    buffer: TensorDictReplayBuffer
    """Holds one batch, of which updates draw minibatches."""
    trainer: Trainer
    genetic: GeneticHook
    """Watches success; evaluates populations unless evolution is disabled."""

    def close(self) -> None:
        """Close the environments."""
        self.genetic.evaluator.close()
        if not self.env.is_closed:
            self.env.close()


def build_training(config: ExperimentConfig) -> Training:
    """Build everything that a run trains with; seeds are the configuration's.

    The global torch generator must have been seeded by the caller: initial weights and
    the policy's noise come from it.

    Raises:
        ValueError: If task and algorithm do not fit, or an option is out of range.
    """
    task = make_task_of(config)
    algorithm, network = config.algorithm, config.network
    env = make_env(
        task,
        algorithm.num_worlds,
        backend=config.task.backend,
        num_threads=config.simulation.num_threads,
        seed=config.seed,
    )
    actor = make_actor(task, network)
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
    collector = Collector(
        env,
        actor,
        frames_per_batch=algorithm.frames_per_batch,
        total_frames=-1,
        auto_register_policy_transforms=False,
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
            total_frames=_NO_FRAME_LIMIT,
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
    genetic = make_genetic_hook(
        config, task, actor=actor, critic=critic, optimizer=optimizer
    )
    genetic.register(trainer)
    return Training(task, env, actor, loss, optimizer, collector, buffer, trainer, genetic)


def make_task_of(config: ExperimentConfig) -> NavigationTask:
    """The task of a run.

    Raises:
        ValueError: If task and algorithm do not fit, or an option is out of range.
    """
    task = make_task_from_config(config.task)
    if task.spec.is_discrete:
        raise ValueError(
            f"task.actions={config.task.actions!r}: "
            f"algorithm.name={config.algorithm.name!r} needs continuous ones"
        )
    return task


def make_actor(task: NavigationTask, network: NetworkConfig) -> ProbabilisticActor:
    """The policy for a task."""
    size = task.spec.action_size
    return make_tanh_normal_actor(
        task.spec.observation_size,
        Bounded(low=-1.0, high=1.0, shape=torch.Size([size]), dtype=torch.float32),
        num_cells=tuple(network.actor_cells),
        activation=ACTIVATIONS[network.activation],
        initial_std=network.initial_std,
    )


def make_genetic_hook(
    config: ExperimentConfig, task: NavigationTask, **parts: Any
) -> GeneticHook:
    """The genetic hook and its evaluator, which has an environment of its own."""
    evolution = config.evolution
    worlds = evolution.num_worlds or (1 + evolution.num_children) * evolution.num_trials
    evaluator = PopulationEvaluator(
        parts["actor"],
        num_episodes=evolution.num_trials,
        create_env_fn=lambda: make_env(
            task,
            worlds,
            backend=config.task.backend,
            num_threads=config.simulation.num_threads,
            seed=config.seed,
        ),
        fitness=evolution.fitness,
        seed=config.seed,
    )
    return GeneticHook(
        evaluator=evaluator,
        num_children=evolution.num_children,
        period_episodes=evolution.period_episodes if evolution.enabled else None,
        mutation=MUTATIONS[evolution.mutation],
        std=standard_deviation(evolution.mut_v, evolution.mut_v_is),
        schedule=_schedule(evolution),
        window_episodes=evolution.window_episodes,
        tie_rule=evolution.tie_rule,
        optimizer_on_switch=evolution.optimizer_on_switch,
        critic_on_switch=evolution.critic_on_switch,
        seed=config.seed,
        **parts,
    )


def _schedule(evolution: EvolutionConfig) -> MutationSchedule:
    return MutationSchedule(tuple(evolution.rates), tuple(evolution.thresholds))
