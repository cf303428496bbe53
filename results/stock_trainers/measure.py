"""Is a race worth something to TorchRL's own trainers?

    python results/stock_trainers/measure.py sac mountain_car 0 1 2   # adds to runs.csv

TorchRL's trainers of SAC and PPO on two tasks whose rewards are rare at first, alone and
with a race, at equal total steps. Success is over held-out episodes of the greedy policy,
at ten marks of the budget; these episodes are not counted, and nothing is chosen by them.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import functools
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from dm_control import suite
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import (
    CatTensors,
    Compose,
    DMControlEnv,
    DoubleToFloat,
    EnvBase,
    FrameSkipTransform,
    GymEnv,
    RewardSum,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType
from torchrl.modules import (
    MLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss, SACLoss, SoftUpdate
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms import PPOTrainer, SACTrainer

from gdrl_torchrl import AttachedRaceHook, genome_of
from gdrl_torchrl.envs.success import ReturnSuccess

FILE = Path(__file__).with_name("runs.csv")
BUDGET, MARKS, HELD_OUT, HELD_OUT_SEED = 40_000, 10, 20, 1_000_000
CAR_STEPS = 300
"""In place of 999, most of which would be the same again."""
TASKS = ("mountain_car", "ball_in_cup")
COLUMNS = ["trainer", "task", "arm", "seed", "area", "final", "agent_steps"]
COLUMNS += ["population_steps", "switches", "wall_s", "curve"]


def make_env(task: str) -> EnvBase:
    """A task with a flag of success: the car has arrived, the ball was in the cup."""
    if task == "mountain_car":
        env = GymEnv("MountainCarContinuous-v0", max_episode_steps=CAR_STEPS)
        # Whoever gets there has a return above 0, and nobody else.
        parts: list[Any] = [RewardSum(), ReturnSuccess(1e-3)]
    else:
        env = DMControlEnv("ball_in_cup", "catch")
        sizes = ["position", "velocity"]
        parts = [
            FrameSkipTransform(4),
            CatTensors(in_keys=sizes, out_key="observation", del_keys=True),
            DoubleToFloat(),
            RewardSum(),
            # Of 250 steps, each of which has a reward of 1 if the ball is then in the cup.
            ReturnSuccess(125.0),
        ]
    return TransformedEnv(env, Compose(*parts))


def make_actor(env: EnvBase, *, own_scale: bool) -> ProbabilisticActor:
    """A squashed Gaussian policy: as TorchRL's examples of SAC and of PPO have it."""
    size, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    scale: list[nn.Module]
    if own_scale:
        outputs, scale = 2 * actions, [NormalParamExtractor()]
    else:
        outputs = actions
        scale = [AddStateIndependentNormalScale(actions, scale_mapping="exp")]
    network = MLP(in_features=size, out_features=outputs, num_cells=[64, 64])
    module = TensorDictModule(
        nn.Sequential(network, *scale), in_keys=["observation"], out_keys=["loc", "scale"]
    )
    return ProbabilisticActor(
        module,
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal,
        distribution_kwargs={
            "low": env.action_spec.space.low,
            "high": env.action_spec.space.high,
        },
        default_interaction_type=ExplorationType.RANDOM,
        return_log_prob=not own_scale,
    )


def make_sac(env: EnvBase) -> tuple[Any, ProbabilisticActor]:
    """TorchRL's SAC trainer."""
    size, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    actor = make_actor(env, own_scale=True)
    critic = ValueOperator(
        MLP(in_features=size + actions, out_features=1, num_cells=[64, 64]),
        in_keys=["observation", "action"],
    )
    loss = SACLoss(actor, critic, num_qvalue_nets=2, action_spec=env.action_spec)
    loss.make_value_estimator(gamma=0.99)
    trainer = SACTrainer(
        collector=Collector(env, actor, frames_per_batch=200, total_frames=BUDGET),
        total_frames=BUDGET,
        frame_skip=1,
        optim_steps_per_batch=50,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
        replay_buffer=TensorDictReplayBuffer(
            storage=LazyTensorStorage(BUDGET), batch_size=256
        ),
        target_net_updater=SoftUpdate(loss, tau=0.005),
        enable_logging=False,
        progress_bar=False,
    )
    return trainer, actor


def make_ppo(env: EnvBase) -> tuple[Any, ProbabilisticActor]:
    """TorchRL's PPO trainer."""
    size = env.observation_spec["observation"].shape[-1]
    actor = make_actor(env, own_scale=False)
    critic = ValueOperator(MLP(in_features=size, out_features=1, num_cells=[64, 64]))
    loss = ClipPPOLoss(actor, critic, entropy_coeff=1e-3)
    trainer = PPOTrainer(
        collector=Collector(env, actor, frames_per_batch=2000, total_frames=BUDGET),
        total_frames=BUDGET,
        frame_skip=1,
        optim_steps_per_batch=None,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
        num_epochs=10,
        replay_buffer=TensorDictReplayBuffer(
            storage=LazyTensorStorage(2000),
            sampler=SamplerWithoutReplacement(),
            batch_size=200,
        ),
        gae=GAE(gamma=0.99, lmbda=0.95, value_network=critic),
        enable_logging=False,
        progress_bar=False,
    )
    return trainer, actor


MAKERS: dict[str, Callable[[EnvBase], tuple[Any, ProbabilisticActor]]] = {
    "sac": make_sac,
    "ppo": make_ppo,
}


class BudgetSpentError(Exception):
    """All steps of a run are taken."""


def run(name: str, task: str, arm: str, seed: int) -> dict[str, Any]:
    """One run, and what its policies reach in held-out episodes."""
    torch.manual_seed(seed)
    env = make_env(task)
    env.set_seed(seed)
    trainer, actor = MAKERS[name](env)
    hook = None
    if arm == "race":
        hook = AttachedRaceHook(
            create_env_fn=functools.partial(make_env, task),
            seed=seed,
            num_members=8,
            num_distilled=3,
            num_again=2,
        )
        hook.register(trainer)
    kept: list[Any] = []

    def population_steps() -> int:
        return 0 if hook is None or hook.race is None else hook.race.counts.steps

    last = genome_of(actor)

    def keep() -> None:
        nonlocal last
        total = trainer.collected_frames + population_steps()
        while len(kept) < MARKS and (len(kept) + 1) * BUDGET / MARKS < total:
            kept.append(last)
        last = genome_of(actor)
        if total >= BUDGET:
            raise BudgetSpentError

    trainer.register_op("post_steps", keep)
    began = time.monotonic()
    with contextlib.suppress(BudgetSpentError):
        trainer.train()
    wall_s = time.monotonic() - began
    kept += [last] * (MARKS - len(kept))
    curve = held_out(task, kept)
    race = None if hook is None else hook.race
    return {
        "trainer": name,
        "task": task,
        "arm": arm,
        "seed": seed,
        "area": round(statistics.fmean(curve), 4),
        "final": curve[-1],
        "agent_steps": trainer.collected_frames,
        "population_steps": population_steps(),
        "switches": 0 if race is None else race.counts.switches,
        "wall_s": round(wall_s, 1),
        "curve": " ".join(str(rate) for rate in curve),
    }


def held_out(task: str, policies: list[Any]) -> list[float]:
    """Success of policies over the same episodes, which nothing else has seen.

    In the plain environments, with the policy written out: twenty times as fast, and
    nothing of what is measured is in the measure.
    """
    rates = []
    for genome in policies:
        won = [
            episode(task, weights_of(genome), HELD_OUT_SEED + k) for k in range(HELD_OUT)
        ]
        rates.append(round(statistics.fmean(won), 3))
    return rates


def weights_of(genome: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights and biases of a policy's layers."""
    leaves = [leaf.numpy() for leaf in genome.values(True, True)]
    pairs = zip(leaves[0::2], leaves[1::2], strict=True)
    return [(w, b) if w.ndim == 2 else (b, w) for w, b in pairs]


def greedy(layers: list[tuple[np.ndarray, np.ndarray]], x: np.ndarray, size: int) -> Any:
    """Actions in [-1, 1]: the mean of the distribution, squashed."""
    for number, (weight, bias) in enumerate(layers):
        x = weight @ x + bias
        x = np.tanh(x) if number < len(layers) - 1 else x
    return np.tanh(x[:size])


@functools.cache
def plain_env(task: str) -> Any:
    """The environment without TorchRL."""
    if task == "mountain_car":
        return gymnasium.make("MountainCarContinuous-v0", max_episode_steps=CAR_STEPS)
    return suite.load("ball_in_cup", "catch")


def episode(task: str, layers: list[tuple[np.ndarray, np.ndarray]], seed: int) -> bool:
    """Whether a policy succeeds in the episode of a seed."""
    env, total = plain_env(task), 0.0
    if task == "mountain_car":
        seen, _ = env.reset(seed=seed)
        while True:
            seen, _, arrived, cut, _ = env.step(greedy(layers, seen, 1))
            if arrived or cut:
                return bool(arrived)
    env.task._random = np.random.RandomState(seed)
    step, action = env.reset(), np.zeros(2)
    for number in range(1000):
        if number % 4 == 0:
            seen = np.concatenate([step.observation[k] for k in ("position", "velocity")])
            action = greedy(layers, seen, 2)
        step = env.step(action)
        total += step.reward or 0.0
        if step.last():
            break
    return total >= 500.0


def main() -> None:
    """Run both arms with each of the seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trainer", choices=sorted(MAKERS))
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("seeds", nargs="+", type=int)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    for seed in arguments.seeds:
        for arm in ("alone", "race"):
            row = run(arguments.trainer, arguments.task, arm, seed)
            sys.stderr.write(f"{row}\n")
            is_new = not FILE.exists()
            with FILE.open("a", newline="") as lines:
                writer = csv.DictWriter(lines, COLUMNS)
                if is_new:
                    writer.writeheader()
                writer.writerow(row)


if __name__ == "__main__":
    main()
