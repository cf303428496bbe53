"""States of environments and collectors, from which they go on."""

from __future__ import annotations

import pytest
import torch
from torchrl.collectors import Collector

from tests.envs.steps import random_steps, walk


def test_a_restored_state_goes_on_bit_by_bit(env_of):
    first, second = env_of(3), env_of(3, seed=9)
    state = walk(first, first.reset(), random_steps(first, 4))[-1]
    saved = {name: value.clone() for name, value in first.get_state().items()}
    second.set_state(saved)
    resumed = second.reset()
    for key in ("observation", "episode_number", "episode_steps", "time_left"):
        assert (resumed[key] == state[key]).all(), key
    actions = random_steps(first, 30, seed=1)

    def go_on(env, state):
        rows = []
        for action in actions:
            moved, state = env.step_and_maybe_reset(state.set("action", action))
            rows.append(moved["next"].clone())
        return torch.stack(rows)

    mine, other = go_on(second, resumed), go_on(first, state.clone())
    assert other["done"].any(), "new episodes must begin on the way"
    for key in other.keys(True, True):
        assert (mine[key] == other[key]).all(), key


def test_a_state_of_other_worlds_is_refused(env_of):
    with pytest.raises(ValueError, match="shape"):
        env_of(3).set_state(env_of(2).get_state())


def test_the_reset_after_the_resumed_one_begins_new_episodes(env_of):
    env = env_of(2)
    env.reset()
    env.set_state(env.get_state())
    assert env.reset()["episode_number"][:, 0].tolist() == [0, 1]
    assert env.reset()["episode_number"][:, 0].tolist() == [2, 3]


@pytest.mark.parametrize("step_limit", [10, 12])
def test_a_collector_goes_on_bit_by_bit_from_a_restored_state(step_limit, env_of, actor_of):
    actor = actor_of("tanh_normal")

    def collect(env, batches):
        collector = Collector(
            env,
            actor,
            frames_per_batch=30,
            total_frames=-1,
            auto_register_policy_transforms=False,
        )
        iterator = iter(collector)
        return [next(iterator).clone() for _ in range(batches)], collector

    # Episodes of ten steps end with the batch: the state is that of new episodes.
    env = env_of(3, step_limit=step_limit)
    torch.manual_seed(5)
    _, collector = collect(env, 2)
    saved, generator = env.get_state(), torch.get_rng_state()
    expected = next(iter(collector)).clone()
    collector.shutdown()

    other = env_of(3, seed=4, step_limit=step_limit)
    other.set_state(saved)
    torch.set_rng_state(generator)
    (batch,), collector = collect(other, 1)
    collector.shutdown()
    for key in batch.exclude("collector").keys(True, True):
        assert (batch[key] == expected[key]).all(), key
