"""PPO's loss and advantages against formulas written out by hand."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from gdrl_torchrl.agents.networks import make_tanh_normal_actor, make_value_network
from gdrl_torchrl.agents.ppo.loss import make_ppo_loss
from gdrl_torchrl.agents.ppo.settings import PPOConfig

WORLDS, TIME = 4, 9


@pytest.fixture
def parts():
    actor = make_tanh_normal_actor(3, Bounded(-1.0, 1.0, shape=(2,)), num_cells=(8,))
    return actor, make_value_network(3, num_cells=(8,))


def make_batch(actor):
    """Random transitions ``[W, T]`` in which episodes end in both ways."""
    generator = torch.Generator().manual_seed(0)
    size = (WORLDS, TIME)
    terminated = torch.zeros(*size, 1, dtype=torch.bool)
    truncated = torch.zeros(*size, 1, dtype=torch.bool)
    terminated[0, 3] = terminated[1, 0] = terminated[2, TIME - 1] = True
    truncated[0, 6] = truncated[3, 4] = True
    batch = TensorDict(
        {
            "observation": torch.randn(*size, 3, generator=generator),
            "next": {
                # After the end of an episode not the observation of the next row.
                "observation": torch.randn(*size, 3, generator=generator),
                "reward": torch.randn(*size, 1, generator=generator),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
        },
        batch_size=size,
    )
    with torch.no_grad():
        return actor(batch)


def brute_force_advantages(batch, critic, gamma, lmbda):
    """Each advantage as its own sum over the rest of its episode."""
    with torch.no_grad():
        value = critic.module(batch["observation"])[..., 0].double()
        following = critic.module(batch["next", "observation"])[..., 0].double()
    reward, terminated, done = (
        batch["next", key][..., 0].double() for key in ("reward", "terminated", "done")
    )
    advantage = torch.zeros(WORLDS, TIME, dtype=torch.float64)
    for world in range(WORLDS):
        for start in range(TIME):
            for end in range(start, TIME):
                # Only a terminal state is worth nothing; a truncated one goes on.
                worth = following[world, end] * (1.0 - terminated[world, end])
                error = reward[world, end] + gamma * worth - value[world, end]
                advantage[world, start] += (gamma * lmbda) ** (end - start) * error
                if done[world, end]:
                    break
    return advantage, value


@pytest.mark.parametrize(("gamma", "lmbda"), [(0.99, 0.95), (0.9, 1.0), (0.9, 0.0)])
def test_advantages_equal_a_sum_over_the_rest_of_the_episode(parts, gamma, lmbda):
    actor, critic = parts
    config = PPOConfig(gamma=gamma, lmbda=lmbda)
    _, estimator = make_ppo_loss(actor, critic, config)
    batch = make_batch(actor)
    expected, value = brute_force_advantages(batch, critic, gamma, lmbda)
    out = estimator(batch)
    assert torch.allclose(out["advantage"][..., 0].double(), expected, atol=1e-5)
    target = expected + value
    assert torch.allclose(out["value_target"][..., 0].double(), target, atol=1e-5)


def test_terminated_and_truncated_ends_differ(parts):
    actor, critic = parts
    _, estimator = make_ppo_loss(actor, critic, PPOConfig())
    batch = make_batch(actor)
    swapped = batch.clone()
    swapped["next", "terminated"] = batch["next", "truncated"]
    swapped["next", "truncated"] = batch["next", "terminated"]
    one, other = (estimator(b)["advantage"][..., 0] for b in (batch, swapped))
    assert (one[0, :7] != other[0, :7]).all()
    assert torch.allclose(one[0, 7:], other[0, 7:], atol=1e-6)


@pytest.mark.parametrize("epsilon", [0.2, 0.05])
@pytest.mark.parametrize("normalize", [True, False])
def test_the_clipped_loss_equals_the_papers_formula(parts, epsilon, normalize):
    actor, critic = parts
    config = PPOConfig(
        clip_epsilon=epsilon, normalize_advantage=normalize, critic_coeff=0.5
    )
    loss, estimator = make_ppo_loss(actor, critic, config)
    batch = estimator(make_batch(actor)).reshape(-1)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
        fresh = actor.get_dist(batch.clone()).log_prob(batch["action"])
    ratio = (fresh - batch["action_log_prob"]).double().exp()
    assert (ratio > 1.0 + epsilon).any()
    assert (ratio < 1.0 - epsilon).any()
    advantage = batch["advantage"][:, 0].double()
    if normalize:
        advantage = (advantage - advantage.mean()) / advantage.std()
    clipped = ratio.clamp(1.0 - epsilon, 1.0 + epsilon)
    expected = -torch.minimum(ratio * advantage, clipped * advantage).mean()
    out = loss(batch.clone())
    assert float(out["loss_objective"].detach()) == pytest.approx(float(expected), rel=1e-3)
    with torch.no_grad():
        error = critic.module(batch["observation"]) - batch["value_target"]
    assert float(out["loss_critic"].detach()) == pytest.approx(
        0.5 * float(error.square().mean()), rel=1e-4
    )


def test_gradients_reach_actor_and_critic_and_stop_at_the_clip(parts):
    actor, critic = parts
    loss, estimator = make_ppo_loss(actor, critic, PPOConfig())
    batch = estimator(make_batch(actor)).reshape(-1)
    out = loss(batch.clone())
    sum(value for key, value in out.items() if key.startswith("loss_")).backward()
    for module in (actor, critic):
        assert any(
            p.grad is not None and p.grad.abs().sum() > 0 for p in module.parameters()
        )

    # Far above the clip with positive advantage: nothing pulls any more.
    far = batch.clone()
    far["action_log_prob"] = far["action_log_prob"] - 5.0
    far["advantage"] = torch.ones_like(far["advantage"])
    actor.zero_grad()
    plain, _ = make_ppo_loss(actor, critic, PPOConfig(normalize_advantage=False))
    plain(far)["loss_objective"].backward()
    assert all(p.grad is None or p.grad.abs().sum() == 0 for p in actor.parameters())


def test_an_entropy_bonus_is_there_when_it_is_asked_for(parts):
    actor, critic = parts
    batch = make_batch(actor)
    plain, estimator = make_ppo_loss(actor, critic, PPOConfig())
    batch = estimator(batch).reshape(-1)
    assert "loss_entropy" not in set(plain(batch.clone()).keys())
    curious, _ = make_ppo_loss(actor, critic, PPOConfig(entropy_coeff=0.01))
    assert "loss_entropy" in set(curious(batch.clone()).keys())
