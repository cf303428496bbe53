# %% [markdown]
# # Genetic evaluations for TorchRL's own PPO, on a Gymnasium task
#
# The agent is a stock PPO, the task is Gymnasium's `Pendulum-v1`. A switch comes after
# the updates on one batch and before the next is collected: to PPO, which learns from
# its current policy's experience only, no batch mixes two policies.

# %%
import logging
import os
import warnings

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import (
    LazyTensorStorage,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.envs import GymEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms import PPOTrainer

from gdrl_torchrl.evolution.hooks.breeding import MutatedChildren
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.operators.schedule import MutationSchedule
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator

FRAMES = int(os.environ.get("GDRL_FRAMES", 10_000))
logging.getLogger("torchrl").setLevel(logging.WARNING)  # it tells of every buffer
torch.set_num_threads(1)  # networks this small gain nothing from more
torch.manual_seed(0)


# %% The task; its episodes last 200 steps.
def make_env() -> GymEnv:
    return GymEnv("Pendulum-v1")


env = make_env()
env.set_seed(0)
observation_size = env.observation_spec["observation"].shape[-1]
action_spec = env.action_spec

# %% The agent, as TorchRL makes it. The spread of its actions does not depend on the
# state; as greedy members do not show it, children inherit it unchanged.
network = nn.Sequential(
    MLP(in_features=observation_size, out_features=1, num_cells=[64, 64]),
    AddStateIndependentNormalScale(1),
)
actor = ProbabilisticActor(
    TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
    in_keys=["loc", "scale"],
    spec=action_spec,
    distribution_class=TanhNormal,
    distribution_kwargs={"low": action_spec.space.low, "high": action_spec.space.high},
    return_log_prob=True,
)
critic = ValueOperator(
    MLP(in_features=observation_size, out_features=1, num_cells=[64, 64])
)
loss = ClipPPOLoss(actor, critic, normalize_advantage=True, entropy_coeff=0.0)
with warnings.catch_warnings():
    # TorchRL calls its trainers prototypes.
    warnings.simplefilter("ignore")
    trainer = PPOTrainer(
        collector=Collector(
            env,
            actor,
            frames_per_batch=500,
            total_frames=FRAMES,
            auto_register_policy_transforms=False,
        ),
        total_frames=FRAMES,
        frame_skip=1,
        optim_steps_per_batch=None,  # an epoch is the whole buffer
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
        num_epochs=5,
        replay_buffer=TensorDictReplayBuffer(
            storage=LazyTensorStorage(500),
            sampler=SamplerWithoutReplacement(),
            batch_size=100,
        ),
        gae=GAE(gamma=0.95, lmbda=0.95, value_network=critic),
        enable_logging=False,
        progress_bar=False,
    )

# %% The genetic part. The evaluator has an environment of its own, for the collector's
# must not be stepped by anyone else.
evaluator = PopulationEvaluator(
    actor,
    num_episodes=3,
    create_env_fn=make_env,
    max_steps=150,
    fitness="return",
)
hook = GeneticHook(
    actor,
    evaluator,
    # The task has no flag of success for the mutation probability to go by.
    MutatedChildren(4, std=0.1, schedule=MutationSchedule(rates=(0.4,), thresholds=())),
    period_episodes=4,
    on_evaluation=[
        lambda found: print(
            f"evaluation {found.number}: returns "
            f"{[round(value) for value in found.scores['return_mean'].tolist()]}"
            f"{', switched' if found.switched else ''}"
        )
    ],
)
hook.register(trainer)


# %% Train, and compare the policy before and after over the same episodes.
def mean_return() -> float:
    """Mean return of the policy, acting greedily."""
    policy = stack_copies(genome_of(actor), 1)
    return float(evaluator.evaluate(policy, seeds=torch.arange(5))["return_mean"])


before = mean_return()
trainer.train()
print(f"mean return {before:.1f} before, {mean_return():.1f} after {FRAMES} frames")
print(
    f"{hook.counts.evaluations} evaluations, {hook.counts.switches} switches, "
    f"{hook.counts.steps} population steps"
)
evaluator.close()
