"""PPO's optimisation by hand, in plain PyTorch: what ours is measured against.

The same arithmetic as the trainer of ``make_ppo_agent``: a squashed Gaussian policy whose
scale is no function of the state, a critic, advantages by a compiled loop, epochs of
shuffled minibatches, the clipped loss.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numba
import numpy as np
import torch
from torch import nn
from torch.nn.functional import mse_loss, softplus

from benchmarks.plain_rainbow import clip_gradient, flatten

LEAST_SCALE = 1e-4
LARGEST_ACTION = 1.0 - 1e-6
"""Beyond it the inverse of tanh is not finite in single precision."""


@numba.njit
def estimate_advantages(
    reward: np.ndarray,
    value: np.ndarray,
    following: np.ndarray,
    done: np.ndarray,
    terminated: np.ndarray,
    gamma: float,
    lmbda: float,
) -> np.ndarray:
    """Generalised advantages ``[W, T]``; only a terminal state has no value."""
    advantage = np.empty_like(value)
    worlds, steps = value.shape
    for world in range(worlds):
        later = 0.0
        for step in range(steps - 1, -1, -1):
            surprise = reward[world, step] - value[world, step]
            if not terminated[world, step]:
                surprise += gamma * following[world, step]
            if done[world, step]:
                later = 0.0
            later = surprise + gamma * lmbda * later
            advantage[world, step] = later
    return advantage


@dataclasses.dataclass
class Collected:
    """Transitions of ``[W, T]`` steps."""

    observation: torch.Tensor
    """``[W, T, D]``."""
    seen: torch.Tensor
    """What the critic sees, before and after the steps: ``[2, W, T, D + 1]``."""
    action: torch.Tensor
    """``[W, T, A]``."""
    log_prob: torch.Tensor
    """Of the actions, when they were taken: ``[W, T]``, as all that follows."""
    reward: torch.Tensor
    done: torch.Tensor
    terminated: torch.Tensor


class Perceptron(nn.Module):
    """Linear layers with tanh between them."""

    def __init__(self, *widths: int) -> None:
        super().__init__()
        pairs = itertools.pairwise(widths)
        self.layers = nn.ModuleList(nn.Linear(*pair) for pair in pairs)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        *hidden, last = self.layers
        for layer in hidden:
            values = layer(values).tanh()
        return last(values)


class Networks(nn.Module):
    """Policy and critic, which sees the time left too."""

    def __init__(
        self, observation_size: int, actions: int, cells: list[int], critic_cells: list[int]
    ) -> None:
        super().__init__()
        self.actor = Perceptron(observation_size, *cells, actions)
        self.log_scale = nn.Parameter(torch.zeros(actions))
        self.critic = Perceptron(observation_size + 1, *critic_cells, 1)


class PPO:
    """Networks and optimiser.

    The parameters are views of one tensor: its norm and Adam are one kernel each.
    """

    def __init__(
        self,
        networks: Networks,
        *,
        num_epochs: int,
        minibatch_size: int,
        learning_rate: float,
        gamma: float,
        lmbda: float,
        clip_epsilon: float,
        critic_coeff: float,
        max_grad_norm: float,
    ) -> None:
        self.networks = networks
        self.weights = flatten(networks)
        self.optimizer = torch.optim.Adam(
            [self.weights], lr=learning_rate, eps=1e-5, fused=True
        )
        self.num_epochs, self.minibatch_size = num_epochs, minibatch_size
        self.gamma, self.lmbda = gamma, lmbda
        self.clip_epsilon, self.critic_coeff = clip_epsilon, critic_coeff
        self.max_grad_norm = max_grad_norm

    def learn(self, batch: Collected) -> None:
        """All epochs of an iteration."""
        tensors = (batch.observation, batch.seen[0])
        tensors += before_tanh(batch.action, batch.log_prob)
        for _ in range(self.num_epochs):
            rows = [tensor.flatten(0, 1) for tensor in tensors + self.estimate(batch)]
            order = torch.randperm(len(rows[0]))
            parts = [row.index_select(0, order).split(self.minibatch_size) for row in rows]
            for minibatch in zip(*parts, strict=True):
                self.step(*minibatch)

    @torch.no_grad()
    def estimate(self, batch: Collected) -> tuple[torch.Tensor, torch.Tensor]:
        """Advantages and targets of the values, ``[W, T]`` each."""
        value, following = self.networks.critic(batch.seen).squeeze(-1)
        advantage = estimate_advantages(
            batch.reward.numpy(),
            value.numpy(),
            following.numpy(),
            batch.done.numpy(),
            batch.terminated.numpy(),
            self.gamma,
            self.lmbda,
        )
        advantage = torch.from_numpy(advantage)
        return advantage, advantage + value

    def step(
        self,
        observation: torch.Tensor,
        seen: torch.Tensor,
        action: torch.Tensor,
        old: torch.Tensor,
        advantage: torch.Tensor,
        target: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """One minibatch ``[B]``; both losses and the norm of the gradient.

        Actions and their old logarithms are those of :func:`before_tanh`.
        """
        deviation, mean = torch.std_mean(advantage)
        advantage = (advantage - mean) / deviation.clamp_min(1e-6)
        networks = self.networks
        scale = networks.log_scale.exp().clamp_min(LEAST_SCALE)
        standard = (action - networks.actor(observation)) / scale
        log_prob = -0.5 * standard.square().sum(-1) - scale.log().sum()
        ratio = (log_prob - old).exp()
        clipped = ratio.clamp(1.0 - self.clip_epsilon, 1.0 + self.clip_epsilon)
        objective = -torch.minimum(ratio * advantage, clipped * advantage).mean()
        error = self.critic_coeff * mse_loss(networks.critic(seen).squeeze(-1), target)
        self.weights.grad.zero_()
        (objective + error).backward()
        norm = clip_gradient(self.weights, self.max_grad_norm)
        self.optimizer.step()
        return objective.detach(), error.detach(), norm


def before_tanh(
    action: torch.Tensor, log_prob: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Actions ``[..., A]`` before squashing, and the logarithms ``[...]`` of those.

    Less the constant of a normal distribution, which every ratio loses.
    """
    action = action.clamp(-LARGEST_ACTION, LARGEST_ACTION).atanh()
    slope = 2.0 * (math.log(2.0) - action - softplus(-2.0 * action))
    constant = 0.5 * math.log(2.0 * math.pi) * action.shape[-1]
    return action, log_prob + slope.sum(-1) + constant
