"""How episodes end: at the limit, at the goal, and what is recorded until then."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from gdrl_tasks import Outcome
from gdrl_tasks.controllers import pursuit
from tests.envs.steps import random_steps, walk


@pytest.mark.parametrize("backend", ["batch", "dm_control"])
def test_a_step_before_the_first_reset_is_an_error(backend, env_of):
    env = env_of(1, backend=backend)
    start = TensorDict(action=env.action_spec.zero(), batch_size=[1])
    with pytest.raises(RuntimeError, match="none has begun"):
        env.step(start)


def test_a_world_that_has_ended_is_not_stepped_on(env_of):
    env = env_of(3, step_limit=2)
    state = walk(env, env.reset(), random_steps(env, 2))[-1].clone()
    assert state["done"].all()
    before = env.get_state()
    with pytest.raises(RuntimeError, match=r"3 of 3 worlds \(world 0: it ended: TIMEOUT\)"):
        env.step(state.set("action", env.action_spec.zero()))
    for name, value in env.get_state().items():
        assert torch.equal(value, before[name]), name
    # The others go on beside it.
    mask = torch.tensor([[True], [False], [True]])
    state = env.reset(state.set("_reset", mask))
    state.set("action", env.action_spec.zero()).set("_step", mask[:, 0])
    following = env.step(state)["next"]
    assert following["done"][:, 0].tolist() == [False, True, False]
    assert following["reward"][1] == 0.0


@pytest.mark.parametrize("backend", ["batch", "dm_control"])
@pytest.mark.parametrize("at_limit", ["terminated", "truncated"])
def test_the_step_limit_terminates_or_truncates(at_limit, backend, env_of):
    env = env_of(2, backend=backend, at_limit=at_limit, step_limit=3)
    path = env.rollout(5, lambda td: td.set("action", env.action_spec.zero()))
    assert path.shape == (2, 3)
    final = path["next"][:, -1]
    assert (final["outcome"] == Outcome.TIMEOUT).all()
    assert final["terminated"].all() == (at_limit == "terminated")
    assert final["truncated"].all() == (at_limit == "truncated")
    assert final["done"].all()
    assert not path["next", "done"][:, :-1].any()
    penalty = -1.0 if at_limit == "terminated" else 0.0
    assert (final["reward"] == penalty).all()
    assert not final["success"].any()


@pytest.mark.parametrize("backend", ["batch", "dm_control"])
def test_reaching_the_goal_terminates_with_success(backend, env_of):
    env = env_of(2, backend=backend, sea="calm", step_limit=160)

    def steer(td):
        action = pursuit(td["observation"].double().numpy())
        return td.set("action", torch.from_numpy(action).float())

    path = env.rollout(160, steer, break_when_any_done=False, break_when_all_done=True)
    final = path["next"][:, -1]
    assert final["success"].all()
    assert (final["outcome"] == Outcome.SUCCESS).all()
    assert final["terminated"].all()
    assert (final["episode_return"] == 1.0).all()
    assert (final["path_length"] > 0.9 * final["shortest_path"]).all()


def test_records_are_of_the_episode_so_far(env_of):
    env = env_of(3, reward="dense")
    path = walk(env, env.reset(), random_steps(env, 5))
    total = path["reward"].cumsum(dim=0)
    assert torch.allclose(path["episode_return"], total, atol=1e-5)
    assert (path["path_length"].diff(dim=0) >= 0).all()
    assert (path["shortest_path"] == path["shortest_path"][:1]).all()
    left = path["time_left"][:, 0, 0].tolist()
    assert left == pytest.approx([1.0 - (n + 1) / 12 for n in range(5)])
