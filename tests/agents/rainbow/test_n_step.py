"""Transitions over several steps against a plain loop over every window."""

from __future__ import annotations

import hypothesis
import hypothesis.strategies as st
import pytest
import torch
from tensordict import TensorDict

from gdrl_torchrl.agents.rainbow.n_step import NStep

KEYS = {
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
    ("next", "done"),
    "steps_to_next_obs",
}


def make_transitions(shape, seed=0, ends=0.2):
    """Random transitions; episodes end in both ways, and everything is recognisable."""
    generator = torch.Generator().manual_seed(seed)
    terminated, truncated = (
        torch.rand(*shape, 1, generator=generator) < ends / 2 for _ in range(2)
    )
    return TensorDict(
        {
            "observation": torch.randn(*shape, 2, generator=generator),
            "action": torch.randint(5, shape, generator=generator),
            "collector": {"traj_ids": torch.zeros(shape)},
            "action_value": torch.zeros(*shape, 3, 5),
            "next": {
                "observation": torch.randn(*shape, 2, generator=generator),
                "reward": torch.randn(*shape, 1, generator=generator),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
                "success": terminated.clone(),
            },
        },
        batch_size=shape,
    )


def brute_force(transitions, gamma, num_steps):
    """One window after another, in double precision: ``{(row, start): fields}``."""
    grid = transitions.reshape(-1, transitions.batch_size[-1])
    worlds, duration = grid.batch_size
    after = grid["next"]
    windows = []
    for world in range(worlds):
        for start in range(duration):
            total, steps = 0.0, 0
            while steps < num_steps and start + steps < duration:
                now = start + steps
                total += gamma**steps * float(after["reward"][world, now, 0])
                steps += 1
                if bool(after["done"][world, now, 0]):
                    break
            windows.append((world, start, start + steps - 1, total, steps))
    return windows


def check(transitions, gamma, num_steps):
    out = NStep(gamma, num_steps)(transitions)
    grid = transitions.reshape(-1, transitions.batch_size[-1])
    windows = brute_force(transitions, gamma, num_steps)
    assert out.batch_size == (len(windows),)
    for row, (world, start, last, total, steps) in zip(out, windows, strict=True):
        first, end = grid[world, start], grid[world, last]
        assert torch.equal(row["observation"], first["observation"])
        assert torch.equal(row["action"], first["action"])
        for key in ("observation", "terminated", "done"):
            assert torch.equal(row["next", key], end["next", key])
        assert float(row["next", "reward"]) == pytest.approx(total, abs=1e-5)
        assert row["steps_to_next_obs"].tolist() == [steps]
    return out


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(
    worlds=st.integers(0, 3),
    duration=st.integers(1, 9),
    num_steps=st.integers(1, 12),
    gamma=st.sampled_from([0.0, 0.5, 0.99, 1.0]),
    ends=st.sampled_from([0.0, 0.3, 0.9]),
    seed=st.integers(0, 100),
)
def test_every_window_equals_a_loop_over_its_steps(
    worlds, duration, num_steps, gamma, ends, seed
):
    shape = (worlds, duration) if worlds else (duration,)
    check(make_transitions(shape, seed, ends), gamma, num_steps)


def test_data_of_an_agent_and_of_whole_episodes_have_the_same_keys_and_shapes():
    n_step = NStep(0.99, 3)
    agent = n_step(make_transitions((4, 6)))
    population = n_step(make_transitions((9,)))
    for out, count in ((agent, 24), (population, 9)):
        assert set(out.keys(True, True)) == KEYS
        assert out["steps_to_next_obs"].shape == (count, 1)
        assert out["next", "reward"].shape == (count, 1)
        assert out["next"].batch_size == (count,)


def test_windows_stop_at_both_ends_of_an_episode_and_only_a_terminal_one_is_final():
    transitions = make_transitions((2, 5), ends=0.0)
    transitions["next", "terminated"][0, 2] = True
    transitions["next", "truncated"][1, 2] = True
    transitions["next", "done"][:, 2] = True
    out = NStep(0.9, 3)(transitions).reshape(2, 5)
    steps = out["steps_to_next_obs"][..., 0]
    # After the third step a new episode, which the batch cuts off.
    assert steps.tolist() == [[3, 2, 1, 2, 1]] * 2
    final = out["next", "terminated"][..., 0]
    assert final.tolist() == [[True, True, True, False, False], [False] * 5]
    assert out["next", "done"][1, :, 0].tolist() == [True, True, True, False, False]
    # A truncated window is continued from the last observation of its episode.
    last = transitions["next", "observation"][1, 2]
    assert (out["next", "observation"][1, :3] == last).all()


def test_episodes_in_one_row_are_as_if_they_came_alone():
    episodes = []
    for seed, duration in enumerate((1, 4, 2, 7)):
        episode = make_transitions((duration,), seed, ends=0.0)
        episode["next", "truncated" if seed % 2 else "terminated"][-1] = True
        episode["next", "done"][-1] = True
        episodes.append(episode)
    n_step = NStep(0.95, 3)
    joined = n_step(torch.cat(episodes))
    alone = torch.cat([n_step(episode) for episode in episodes])
    assert (joined == alone).all()


def test_one_step_changes_nothing():
    transitions = make_transitions((3, 4))
    out = NStep(0.5, 1)(transitions)
    assert (out["steps_to_next_obs"] == 1).all()
    for key in KEYS - {"steps_to_next_obs"}:
        assert torch.equal(out[key], transitions[key].reshape(out[key].shape))


def test_the_input_is_not_modified_and_shares_no_memory_with_the_output():
    transitions = make_transitions((3, 6))
    before = transitions.clone()
    out = NStep(0.9, 3)(transitions)
    for leaf in out.values(True, True):
        leaf.zero_()
    assert set(transitions.keys(True, True)) == set(before.keys(True, True))
    assert (transitions == before).all()


def test_a_reward_that_is_not_a_number_stays_in_its_episode():
    transitions = make_transitions((6,), ends=0.0)
    transitions["next", "done"][2] = True
    transitions["next", "reward"][3] = torch.nan
    reward = NStep(0.9, 3)(transitions)["next", "reward"][:, 0]
    assert reward.isnan().tolist() == [False, False, False, True, False, False]


def test_many_episodes_take_little_memory_and_time():
    # TorchRL's MultiStep would make a copy of these per episode: 20 GB.
    transitions = make_transitions((100_000,), ends=0.02)
    out = NStep(0.99, 3)(transitions)
    assert out["steps_to_next_obs"].float().mean() > 2.8


@pytest.mark.parametrize(("gamma", "num_steps"), [(0.9, 0), (1.1, 3), (-0.1, 3)])
def test_unusable_options_are_refused(gamma, num_steps):
    with pytest.raises(ValueError, match="must be"):
        NStep(gamma, num_steps)


def test_transitions_of_other_shapes_are_refused():
    with pytest.raises(ValueError, match=r"\[T\] or \[W, T\]"):
        NStep(0.9, 3)(make_transitions((2, 3, 4)))
