# %% [markdown]
# # Genetic evaluations for TorchRL's own SAC, on a dm_control task
#
# Agent and task are not this package's: the one is TorchRL's SAC with its trainer, the
# other is `cartpole balance` of the dm_control suite. Every few episodes `GeneticHook`
# lets mutated children of the policy compete with it, and `PopulationEvaluator` scores
# them by their return.

# %%
import logging
import os
import warnings

# Nothing is drawn, and without a display dm_control would warn about it.
os.environ.setdefault("MUJOCO_GL", "disable")

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    CatTensors,
    Compose,
    DMControlEnv,
    DoubleToFloat,
    StepCounter,
    TransformedEnv,
)
from torchrl.modules import (
    MLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import SACLoss, SoftUpdate
from torchrl.trainers.algorithms import SACTrainer

from gdrl_torchrl.evolution.hooks.breeding import MutatedChildren
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.operators.schedule import MutationSchedule
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator

FRAMES = int(os.environ.get("GDRL_FRAMES", 6_000))
EPISODE_STEPS = 100
logging.getLogger("torchrl").setLevel(logging.WARNING)  # it tells of every buffer
torch.set_num_threads(1)  # networks this small gain nothing from more
torch.manual_seed(0)


# %% The task: the parts of an observation side by side, in single precision.
def make_env() -> TransformedEnv:
    return TransformedEnv(
        DMControlEnv("cartpole", "balance", frame_skip=5),
        Compose(
            CatTensors(["position", "velocity"], "observation"),
            DoubleToFloat(),
            StepCounter(EPISODE_STEPS),
        ),
    )


env = make_env()
env.set_seed(0)
observation_size = env.observation_spec["observation"].shape[-1]
action_spec = env.action_spec

# %% The agent, as TorchRL makes it.
network = nn.Sequential(
    MLP(in_features=observation_size, out_features=2, num_cells=[64, 64]),
    NormalParamExtractor(),
)
actor = ProbabilisticActor(
    TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
    in_keys=["loc", "scale"],
    spec=action_spec,
    distribution_class=TanhNormal,
    distribution_kwargs={"low": action_spec.space.low, "high": action_spec.space.high},
)
critic = ValueOperator(
    MLP(in_features=observation_size + 1, out_features=1, num_cells=[64, 64]),
    in_keys=["observation", "action"],
)
loss = SACLoss(actor, critic)
loss.make_value_estimator(gamma=0.99)
with warnings.catch_warnings():
    # TorchRL calls its trainers prototypes.
    warnings.simplefilter("ignore")
    trainer = SACTrainer(
        collector=Collector(
            env,
            actor,
            frames_per_batch=100,
            total_frames=FRAMES,
            init_random_frames=500,
            auto_register_policy_transforms=False,
        ),
        total_frames=FRAMES,
        frame_skip=1,
        optim_steps_per_batch=25,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
        replay_buffer=TensorDictReplayBuffer(
            storage=LazyTensorStorage(FRAMES), batch_size=128
        ),
        target_net_updater=SoftUpdate(loss, tau=0.005),
        enable_logging=False,
        progress_bar=False,
    )

# %% The genetic part. The evaluator has an environment of its own, for the collector's
# must not be stepped by anyone else.
evaluator = PopulationEvaluator(
    actor,
    num_episodes=2,
    create_env_fn=make_env,
    max_steps=EPISODE_STEPS,
    fitness="return",
)
hook = GeneticHook(
    actor,
    evaluator,
    # The task has no flag of success for the mutation probability to go by.
    MutatedChildren(3, std=0.1, schedule=MutationSchedule(rates=(0.4,), thresholds=())),
    period_episodes=8,
    on_evaluation=[
        lambda found: print(
            f"evaluation {found.number}: returns "
            f"{[round(value) for value in found.scores['return_mean'].tolist()]}"
            f"{', switched' if found.switched else ''}"
        )
    ],
    # No `on_switch`: SAC's target networks are those of the critics, which stay.
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
