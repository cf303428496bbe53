"""A flag of success that is made of an episode's return."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import Compose, GymEnv, RewardSum, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from gdrl_torchrl.envs.success import ReturnSuccess
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch


def cartpole():
    flag = Compose(RewardSum(), ReturnSuccess(12.0))
    return TransformedEnv(GymEnv("CartPole-v1"), flag)


def test_specs_tell_what_the_environment_gives():
    check_env_specs(cartpole())


def test_the_flag_is_whether_the_return_so_far_is_enough():
    env = cartpole()
    env.set_seed(0)
    steps = env.rollout(60, break_when_any_done=False)
    done = steps["next", "done"].flatten().tolist()
    flags = steps["next", "success"].flatten().tolist()
    total = 0.0
    for reward, flag, ended in zip(
        steps["next", "reward"].flatten().tolist(), flags, done, strict=True
    ):
        total += reward
        assert flag == (total >= 12.0)
        total = 0.0 if ended else total
    assert {True, False} == set(flags)
    assert sum(done) > 1, "the return began anew"
    assert not steps["success"][0]


def test_a_watch_counts_successes_of_worlds():
    env = SerialEnv(3, cartpole)
    env.set_seed(0)
    batch = env.rollout(80, break_when_any_done=False)
    watch = EpisodeWatch(window_episodes=50)
    ends = batch["next", "done"]
    # Episodes of a world one after another, as a collector numbers them.
    number = ends.long().cumsum(1).roll(1, 1)
    number[:, 0] = 0
    batch["episode_number"] = 3 * number + torch.arange(3)[:, None, None]
    watch.observe(batch)
    expected = int((batch["next", "success"] & ends).sum())
    assert watch.episodes_completed == int(ends.sum())
    assert expected > 0
    watch.window.forget_running()
    assert watch.window.num_successes == expected


@pytest.mark.parametrize("threshold", [0.0, -1.0, float("nan")])
def test_a_threshold_that_nobody_could_miss_is_refused(threshold):
    with pytest.raises(ValueError, match=r"threshold=.* must be > 0"):
        ReturnSuccess(threshold)
