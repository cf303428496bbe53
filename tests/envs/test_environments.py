"""The TorchRL environments of a task, on both backends: specs, masks, episodes."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv
from torchrl.envs.utils import check_env_specs

from gdrl_tasks import Outcome, Stream, make_task
from gdrl_tasks.seeds import stream_of
from gdrl_torchrl.envs.make import make_env
from gdrl_torchrl.envs.navigation import NavigationEnv
from tests.envs.steps import RECORD, WAVES, random_steps, walk

# Specs


@pytest.mark.parametrize("backend", ["batch", "dm_control"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"actions": "discrete"},
        {"extra_observations": ("velocity", "roll", "time_left"), "reward": "dense"},
        {"at_limit": "truncated", "step_limit": 2},
    ],
    ids=["default", "discrete", "extras", "truncated"],
)
def test_specs_hold(backend, options, env_of):
    env = env_of(2, backend=backend, **options)
    assert env.batch_size == torch.Size([2])
    check_env_specs(env, break_when_any_done="both")


@pytest.mark.parametrize("backend", ["batch", "dm_control"])
def test_everything_is_float32_and_every_record_is_there(backend, env_of):
    env = env_of(2, backend=backend)
    path = env.rollout(2)
    for key in path.keys(True, True):
        if path[key].dtype.is_floating_point:
            assert path[key].dtype == torch.float32, key
    assert set(path["next"].keys()) >= RECORD | {"observation", "reward", "done"}
    assert path["observation"].shape == (2, 2, 3)
    assert path["next", "reward"].shape == (2, 2, 1)


def test_both_backends_play_the_same_episode(env_of):
    seeds = torch.tensor([4, 5])
    batch, suite = env_of(2), env_of(2, backend="dm_control")
    paths = [
        walk(env, start, random_steps(env, 10))
        for env, start in (
            (batch, batch.reset(episode_seed=seeds)),
            (suite, suite.reset(list_of_kwargs=[{"episode_seed": int(s)} for s in seeds])),
        )
    ]
    for key in RECORD | {"observation", "reward", "done", "terminated", "truncated"}:
        mine, other = (path[key].double() for path in paths)
        assert torch.allclose(mine, other, atol=1e-6), key


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"worlds": 0}, "num_worlds=0"),
        ({"worlds": -2}, "num_worlds=-2"),
        ({"backend": "gpu"}, "backend='gpu'"),
    ],
)
def test_bad_arguments_are_named(arguments, message, env_of):
    with pytest.raises(ValueError, match=message):
        env_of(**arguments)


# Masks


def test_a_partial_reset_begins_episodes_in_those_worlds_only(env_of):
    env = env_of(4)
    state = walk(env, env.reset(), random_steps(env, 3))[-1]
    mask = torch.tensor([False, True, False, True])
    again = env.reset(state.clone().set("_reset", mask[:, None]))
    kept = ~mask
    for key in ("observation", "episode_number", "episode_seed", "episode_steps"):
        assert (again[key][kept] == state[key][kept]).all(), key
        assert (again[key][mask] != state[key][mask]).any(), key
    assert (again["episode_steps"][mask] == 0).all()
    assert again["episode_number"][mask, 0].tolist() == [4, 5]
    following = env.step(again.set("action", env.action_spec.zero()))["next"]
    assert following["episode_steps"][:, 0].tolist() == [4, 1, 4, 1]


def test_frozen_worlds_stay_bit_by_bit_and_the_others_do_not_notice(env_of):
    seeds = torch.arange(4)
    free, held = env_of(4), env_of(4)
    actions = random_steps(free, 6)
    whole = walk(free, free.reset(episode_seed=seeds), actions)
    mask = torch.tensor([True, False, True, False])
    state = held.reset(episode_seed=seeds)
    state = held.step(state.set("action", actions[0]))["next"].clone()
    before, start = held.get_state(), state.clone()
    for action in actions[1:]:
        state.set("action", action).set("_step", mask)
        state = held.step(state)["next"].clone()
    after = held.get_state()
    for name, value in before.items():
        if value.shape[:1] == mask.shape:
            assert torch.equal(after[name][~mask], value[~mask]), name
    for key in ("observation", "episode_steps", "episode_return"):
        assert (state[key][~mask] == start[key][~mask]).all(), key
        assert (state[key][mask] == whole[-1][key][mask]).all(), key
    assert not state["done"][~mask].any()


def test_frozen_worlds_are_not_stepped(env_of, monkeypatch):
    env = env_of(4)
    state = env.reset()
    asked = []
    step = env.simulation.step

    def counted(action, ids=None):
        asked.append(4 if ids is None else len(ids))
        return step(action, ids)

    monkeypatch.setattr(env.simulation, "step", counted)
    action = env.action_spec.rand()
    env.step(state.clone().set("action", action))
    mask = torch.tensor([False, True, False, False])
    env.step(state.clone().set("action", action).set("_step", mask))
    assert asked == [4, 1]


def test_a_world_that_has_ended_stays_done_while_it_is_frozen(env_of):
    env = env_of(3, step_limit=2)
    state = walk(env, env.reset(), random_steps(env, 1))[-1]
    mask = torch.tensor([True, False, True])
    state = env.step(state.set("action", env.action_spec.zero()).set("_step", mask))["next"]
    assert state["done"][:, 0].tolist() == [True, False, True]
    mask = ~mask
    state = env.step(
        state.clone().set("action", env.action_spec.zero()).set("_step", mask)
    )["next"]
    assert state["done"].all()
    assert state["terminated"].all()
    assert state["reward"][:, 0].tolist() == [0.0, -1.0, 0.0]


# Episodes


def test_the_same_seeds_are_the_same_episodes(env_of):
    seeds = torch.tensor([7, 8, 7, 9])
    paths = []
    for env in (env_of(4, seed=0), env_of(4, seed=5)):
        start = env.reset(episode_seed=seeds)
        assert start["episode_seed"][:, 0].tolist() == seeds.tolist()
        assert (start["observation"][0] == start["observation"][2]).all()
        assert (start["observation"][0] != start["observation"][1]).any()
        paths.append(walk(env, start, random_steps(env, 8)))
    for key in ("observation", "reward", "done", "path_length"):
        assert (paths[0][key] == paths[1][key]).all(), key


def test_seeds_can_be_given_to_a_partial_reset(env_of):
    env = env_of(3)
    state = env.reset(episode_seed=torch.tensor([1, 2, 3]))
    mask = torch.tensor([[False], [True], [False]])
    again = env.reset(
        state.clone().set("_reset", mask), episode_seed=torch.tensor([7, 8, 9])
    )
    assert again["episode_seed"][:, 0].tolist() == [1, 8, 3]


def test_episodes_that_are_not_chosen_are_of_the_training_stream(env_of):
    env = env_of(4)
    first, second = (env.reset()["episode_seed"][:, 0] for _ in range(2))
    assert (stream_of(first.numpy()) == Stream.TRAINING).all()
    assert len(set(first.tolist()) | set(second.tolist())) == 8
    env.set_seed(3)
    third = env.reset()["episode_seed"]
    env.set_seed(3)
    assert (env.reset()["episode_seed"] == third).all()


def test_without_a_seed_every_environment_plays_other_episodes_that_can_be_played_again():
    task = make_task("water", **WAVES)
    first, second = (NavigationEnv(task, 3, num_threads=1) for _ in range(2))
    one, other = (env.reset()["episode_seed"] for env in (first, second))
    assert len(set(one.flatten().tolist()) | set(other.flatten().tolist())) == 6
    again = NavigationEnv(task, 3, num_threads=1, seed=first.simulation.seed)
    assert (again.reset()["episode_seed"] == one).all()
    first.set_seed(7), second.set_seed(7)
    assert (first.reset()["episode_seed"] == second.reset()["episode_seed"]).all()


@pytest.mark.full
@pytest.mark.parametrize("backend", ["batch", "dm_control"])
def test_two_workers_without_a_seed_play_other_episodes(backend):
    task = make_task("water", **WAVES)
    make = functools.partial(make_env, task, 2, backend=backend, num_threads=1)
    workers = ParallelEnv(2, make)
    try:
        start = workers.reset()
        assert len(set(start["episode_seed"].flatten().tolist())) == 4
        assert len(set(start["observation"][..., 1].flatten().tolist())) == 4
    finally:
        workers.close()


@pytest.mark.parametrize("backend", ["batch", "dm_control"])
def test_a_collector_gets_whole_batches_across_episodes(backend, env_of, actor_of):
    env = env_of(2, backend=backend, step_limit=4)
    collector = Collector(
        env,
        actor_of("tanh_normal"),
        frames_per_batch=20,
        total_frames=40,
        auto_register_policy_transforms=False,
    )
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    assert [batch.shape for batch in batches] == [torch.Size([2, 10])] * 2
    path = torch.cat(batches, dim=1)
    done = path["next", "done"][..., 0]
    assert done[:, 3::4].all()
    running = ~done[:, :-1]
    following, root = path["next", "observation"][:, :-1], path["observation"][:, 1:]
    assert (following[running] == root[running]).all()
    seeds = path["episode_seed"][..., 0]
    assert (seeds[:, 0] != seeds[:, 4]).all(), "a new episode after the end"
    assert (seeds[:, 0] == seeds[:, 3]).all()


def test_actions_with_gradients_are_taken(env_of, actor_of):
    env = env_of(2)
    path = env.rollout(2, actor_of("tanh_normal"))
    assert path["next", "reward"].shape == (2, 2, 1)


def test_a_world_whose_action_is_not_a_number_diverges_alone(env_of):
    env = env_of(3)
    action = env.action_spec.zero()
    action[1] = float("nan")
    following = env.step(env.reset().set("action", action))["next"]
    assert following["outcome"][:, 0].tolist() == [
        Outcome.RUNNING,
        Outcome.DIVERGED,
        Outcome.RUNNING,
    ]
    assert following["terminated"][:, 0].tolist() == [False, True, False]
    assert np.isfinite(following["observation"].numpy()).all()


def test_a_closed_environment_can_be_closed_again():
    env = NavigationEnv(make_task("water", **WAVES), 2, num_threads=2, seed=0)
    env.close()
    env.close(raise_if_closed=False)
    assert env.is_closed
