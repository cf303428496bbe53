"""TorchRL's own trainers on small problems, and hooks for them."""

from __future__ import annotations

import copy

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv
from torchrl.modules import MLP, EGreedyModule, ValueOperator
from torchrl.objectives import DQNLoss, SoftUpdate
from torchrl.trainers.algorithms import DQNTrainer

from gdrl_torchrl.evolution.hooks.attach import AttachedGeneticHook

FRAMES = 300


def pendulum():
    return GymEnv("Pendulum-v1")


def cartpole():
    return GymEnv("CartPole-v1")


def state_value():
    return ValueOperator(MLP(in_features=3, out_features=1, num_cells=[8]))


def action_value():
    network = MLP(in_features=4, out_features=1, num_cells=[8])
    return ValueOperator(network, in_keys=["observation", "action"])


def trainer_of(cls, loss, policy, env, *, frames=FRAMES, **options):
    loss.make_value_estimator(gamma=0.99)
    env.set_seed(0)
    return cls(
        collector=Collector(
            env,
            policy,
            frames_per_batch=50,
            total_frames=frames,
            max_frames_per_traj=20,
            auto_register_policy_transforms=False,
        ),
        total_frames=frames,
        frame_skip=1,
        optim_steps_per_batch=2,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
        replay_buffer=TensorDictReplayBuffer(
            storage=LazyTensorStorage(1000), batch_size=16
        ),
        target_net_updater=SoftUpdate(loss, tau=0.01),
        enable_logging=False,
        progress_bar=False,
        **options,
    )


def make_dqn(actor_of, frames=FRAMES, *, apart=False, **options):
    env = cartpole()
    actor = actor_of("q_value", 4, env.action_spec)
    loss = DQNLoss(actor, double_dqn=True, action_space=env.action_spec)
    greedy = EGreedyModule(env.action_spec, annealing_num_steps=100)
    policy = TensorDictSequential(actor, greedy)
    policy = copy.deepcopy(policy) if apart else policy
    options = {"greedy_module": greedy} | options
    return trainer_of(DQNTrainer, loss, policy, env, frames=frames, **options), actor


def hook_for(create_env_fn, **options):
    small = {"num_children": 3, "period_episodes": 2, "num_trials": 1, "max_steps": 15}
    strong = {"mut_v": 1.0, "rates": [1.0], "thresholds": []}
    return AttachedGeneticHook(create_env_fn=create_env_fn, **small | strong | options)
