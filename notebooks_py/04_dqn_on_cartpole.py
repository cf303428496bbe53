# %% [markdown]
# # Genetic evaluations for TorchRL's own DQN, on CartPole
#
# The agent is a stock DQN that explores epsilon-greedily, the task is Gymnasium's
# `CartPole-v1`. Children are mutated value networks, and the target network has to
# follow when one of them becomes the agent.

# %%
import logging
import os
import warnings

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv
from torchrl.modules import MLP, EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate
from torchrl.trainers.algorithms import DQNTrainer

from gdrl_torchrl.evolution.hooks.breeding import MutatedChildren
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.hooks.hand_over import HandOver
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.operators.schedule import MutationSchedule
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator

FRAMES = int(os.environ.get("GDRL_FRAMES", 10_000))
logging.getLogger("torchrl").setLevel(logging.WARNING)  # it tells of every buffer
torch.set_num_threads(1)  # networks this small gain nothing from more
torch.manual_seed(0)


# %% The task.
def make_env() -> GymEnv:
    return GymEnv("CartPole-v1")


env = make_env()
env.set_seed(0)

# %% The agent, as TorchRL makes it. What evolves is the greedy policy, and only the
# collector's has random actions.
actor = QValueActor(
    MLP(in_features=4, out_features=2, num_cells=[64, 64]),
    in_keys=["observation"],
    spec=env.action_spec,
)
explorer = EGreedyModule(
    env.action_spec, eps_init=1.0, eps_end=0.05, annealing_num_steps=max(1, FRAMES // 2)
)
loss = DQNLoss(actor, double_dqn=True, action_space=env.action_spec)
loss.make_value_estimator(gamma=0.99)
with warnings.catch_warnings():
    # TorchRL calls its trainers prototypes.
    warnings.simplefilter("ignore")
    trainer = DQNTrainer(
        collector=Collector(
            env,
            TensorDictSequential(actor, explorer),
            frames_per_batch=50,
            total_frames=FRAMES,
            init_random_frames=200,
            auto_register_policy_transforms=False,
        ),
        total_frames=FRAMES,
        frame_skip=1,
        optim_steps_per_batch=10,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
        replay_buffer=TensorDictReplayBuffer(
            storage=LazyTensorStorage(FRAMES), batch_size=128
        ),
        target_net_updater=SoftUpdate(loss, tau=0.01),
        greedy_module=explorer,
        enable_logging=False,
        progress_bar=False,
    )


# %% The genetic part. The evaluator has an environment of its own, for the collector's
# must not be stepped by anyone else.
@torch.no_grad()
def copy_to_target() -> None:
    """Values learned against the network that was replaced would pull it back."""
    loss.target_value_network_params.data.update_(loss.value_network_params.data)


evaluator = PopulationEvaluator(
    actor,
    num_episodes=3,
    create_env_fn=make_env,
    max_steps=200,
    fitness="return",
)
hook = GeneticHook(
    actor,
    evaluator,
    # The task has no flag of success for the mutation probability to go by.
    MutatedChildren(4, std=0.05, schedule=MutationSchedule(rates=(0.4,), thresholds=())),
    period_episodes=20,
    hand_over=HandOver(on_switch=[copy_to_target]),
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
    return float(evaluator.evaluate(policy, seeds=torch.arange(10))["return_mean"])


before = mean_return()
trainer.train()
print(f"mean return {before:.1f} before, {mean_return():.1f} after {FRAMES} frames")
print(
    f"{hook.counts.evaluations} evaluations, {hook.counts.switches} switches, "
    f"{hook.counts.steps} population steps"
)
evaluator.close()
