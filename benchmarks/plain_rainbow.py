"""Rainbow's update by hand, in plain PyTorch: what ours is measured against.

The same arithmetic as ``RainbowLearner``: prioritised replay in a compiled sum tree, a
dueling distributional network, double selection, the projection of the target, priorities
by KL divergence. One file, for one device and one shape of transitions.
"""

from __future__ import annotations

import copy

import numba
import numpy as np
import torch
from torch import nn
from torch.nn.functional import linear


@numba.njit
def write_leaves(
    tree: np.ndarray, rows: np.ndarray, priority: np.ndarray, alpha: float, eps: float
) -> float:
    """Set ``(priority + eps)^alpha`` of rows; the largest priority of them."""
    leaves = len(tree) // 2
    largest = 0.0
    for row, value in zip(rows, priority):  # noqa: B905 - compiled
        largest = max(largest, value)
        node = leaves + row
        tree[node] = (value + eps) ** alpha
        while node > 1:
            node //= 2
            tree[node] = tree[2 * node] + tree[2 * node + 1]
    return largest


@numba.njit
def find_leaves(
    tree: np.ndarray, shares: np.ndarray, beta: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows at shares of the sum, and their weights relative to the largest of them."""
    leaves = len(tree) // 2
    rows = np.empty(len(shares), np.int64)
    weight = np.empty(len(shares), np.float32)
    smallest = np.inf
    for place in range(len(shares)):
        rest = shares[place] * tree[1]
        node = 1
        while node < leaves:
            node *= 2
            # An empty right half is never entered, whatever rounding left over.
            if rest > tree[node] and tree[node + 1] > 0.0:
                rest -= tree[node]
                node += 1
        rows[place] = node - leaves
        weight[place] = tree[node]
        smallest = min(smallest, tree[node])
    for place in range(len(shares)):
        weight[place] = (weight[place] / smallest) ** -beta
    return rows, weight


class Replay:
    """Prioritised replay of transitions over several steps."""

    def __init__(self, capacity: int, observation_size: int, alpha: float) -> None:
        self.alpha, self.eps = alpha, 1e-6
        self.tree = np.zeros(2 << (capacity - 1).bit_length())
        self.capacity, self.cursor, self.largest = capacity, 0, 1.0
        self.observation = torch.empty(capacity, observation_size)
        self.action = torch.empty(capacity, dtype=torch.long)
        self.following = torch.empty(capacity, observation_size)
        self.reward = torch.empty(capacity, 1)
        # Of the value that follows: 0 after a terminal state.
        self.discount = torch.empty(capacity, 1)

    def extend(
        self,
        observation: torch.Tensor,
        action: torch.Tensor,
        following: torch.Tensor,
        reward: torch.Tensor,
        discount: torch.Tensor,
    ) -> None:
        """Add transitions ``[N]`` in place of the oldest ones."""
        count = len(action)
        rows = torch.arange(self.cursor, self.cursor + count) % self.capacity
        self.cursor = (self.cursor + count) % self.capacity
        self.observation[rows], self.action[rows] = observation, action
        self.following[rows], self.reward[rows] = following, reward
        self.discount[rows] = discount
        self.write(rows, torch.full((count,), self.largest))

    def find(self, shares: np.ndarray, beta: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows and weights ``[B]`` at shares of the sum of all priorities."""
        rows, weight = find_leaves(self.tree, shares, beta)
        return torch.from_numpy(rows), torch.from_numpy(weight)

    def write(self, rows: torch.Tensor, priority: torch.Tensor) -> None:
        """Set priorities ``[B]``."""
        largest = write_leaves(
            self.tree, rows.numpy(), priority.numpy(), self.alpha, self.eps
        )
        self.largest = max(self.largest, largest)


class NoisyLinear(nn.Module):
    """A layer with factorised noise; ``streams`` equal layers of one input side by side."""

    def __init__(self, inputs: int, outputs: int, streams: int = 1) -> None:
        super().__init__()
        self.streams = streams
        self.weight = nn.Parameter(torch.empty(outputs, inputs))
        self.bias = nn.Parameter(torch.empty(outputs))
        self.weight_scale = nn.Parameter(torch.empty(outputs, inputs))
        self.bias_scale = nn.Parameter(torch.empty(outputs))
        self.register_buffer("weight_noise", torch.zeros(outputs, inputs))
        self.register_buffer("bias_noise", torch.zeros(outputs))

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        weight = torch.addcmul(self.weight, self.weight_scale, self.weight_noise)
        bias = torch.addcmul(self.bias, self.bias_scale, self.bias_noise)
        return linear(values, weight, bias)

    @torch.no_grad()
    def draw(self) -> None:
        """New noise."""
        outputs, inputs = self.weight.shape
        noise = torch.randn(outputs + self.streams * inputs)
        noise = noise.abs().sqrt_().copysign_(noise)
        after, before = noise.split([outputs, self.streams * inputs])
        self.bias_noise.copy_(after)
        torch.mul(
            after.view(self.streams, -1, 1),
            before.view(self.streams, 1, -1),
            out=self.weight_noise.view(self.streams, -1, inputs),
        )


class DuelingNetwork(nn.Module):
    """Logits ``[B, A, Z]`` of two streams, whose first layers are one product."""

    def __init__(
        self, observation_size: int, width: int, actions: int, atoms: int, noisy: bool
    ) -> None:
        super().__init__()
        kind = NoisyLinear if noisy else nn.Linear
        self.shape = (-1, actions, atoms)
        self.features = nn.Linear(observation_size, width)
        options = {"streams": 2} if noisy else {}
        self.hidden = kind(width, 2 * width, **options)
        self.advantage = kind(width, actions * atoms)
        self.value = kind(width, atoms)
        self.noisy = [m for m in self.modules() if isinstance(m, NoisyLinear)]

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        hidden = self.hidden(self.features(observation).relu()).relu()
        apart, together = hidden.chunk(2, dim=-1)
        advantage = self.advantage(apart).view(self.shape)
        shared = self.value(together) - advantage.mean(dim=1)
        return advantage + shared.unsqueeze(1)


class Rainbow:
    """Network, target network, optimiser and replay.

    The parameters of a network are views of one tensor: their norm, Adam and the target
    network's step are then one kernel each. ``support`` ``[Z]`` has the atoms' returns.
    """

    def __init__(
        self,
        network: DuelingNetwork,
        replay: Replay,
        support: torch.Tensor,
        *,
        batch_size: int,
        learning_rate: float,
        tau: float,
        max_grad_norm: float,
        beta: float,
        beta_increment: float,
    ) -> None:
        self.network, self.replay, self.support = network, replay, support
        self.target = copy.deepcopy(network).requires_grad_(False)
        self.target_weights = flatten(self.target).detach()
        self.weights = flatten(network)
        self.optimizer = torch.optim.Adam(
            [self.weights], lr=learning_rate, eps=1e-4, fused=True
        )
        self.batch_size, self.tau, self.max_grad_norm = batch_size, tau, max_grad_norm
        self.beta, self.beta_increment = beta, beta_increment
        self.random = np.random.default_rng(0)
        self.lowest = float(support[0])
        self.gap = float(support[-1] - support[0]) / (len(support) - 1)
        actions = network.shape[1]
        self.first_actions = torch.arange(0, batch_size * actions, actions)

    def update(self) -> None:
        """Draw a minibatch and learn from it."""
        for layer in (*self.network.noisy, *self.target.noisy):
            layer.draw()
        shares = self.random.random(self.batch_size)
        self.learn(*self.replay.find(shares, self.beta))
        self.beta = min(1.0, self.beta + self.beta_increment)

    def learn(
        self, rows: torch.Tensor, weight: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """One update with transitions ``[B]`` and their weights; loss and norm."""
        loss, priority = self.loss(rows, weight)
        self.weights.grad.zero_()
        loss.backward()
        norm = clip_gradient(self.weights, self.max_grad_norm)
        self.optimizer.step()
        self.target_weights.lerp_(self.weights.data, self.tau)
        self.replay.write(rows, priority)
        return loss.detach(), norm

    def loss(
        self, rows: torch.Tensor, weight: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Weighted cross-entropy, and the KL divergences ``[B]``."""
        replay = self.replay
        with torch.no_grad():
            target = self.project(
                self.values_ahead(replay.following.index_select(0, rows)),
                replay.reward.index_select(0, rows),
                replay.discount.index_select(0, rows),
            )
        logits = self.network(replay.observation.index_select(0, rows))
        chosen = self.of_actions(logits, replay.action.index_select(0, rows))
        entropy = -(target * chosen.log_softmax(-1)).sum(-1)
        with torch.no_grad():
            divergence = entropy + torch.xlogy(target, target).sum(-1)
        return (entropy * weight).mean(), divergence.clamp_min_(0.0)

    def values_ahead(self, following: torch.Tensor) -> torch.Tensor:
        """Probabilities ``[B, Z]`` that the target network gives the best actions."""
        best = (self.network(following).softmax(-1) @ self.support).argmax(-1)
        return self.of_actions(self.target(following), best).softmax(-1)

    def project(
        self, values: torch.Tensor, reward: torch.Tensor, discount: torch.Tensor
    ) -> torch.Tensor:
        """Distribution ``[B, Z]`` of ``reward + discount * value`` on the support."""
        last = len(self.support) - 1
        returns = torch.addcmul(reward, discount, self.support)
        position = returns.sub_(self.lowest).div_(self.gap).clamp_(0.0, last)
        below = position.long().clamp_(max=last - 1)
        upper = values * (position - below)
        projected = torch.zeros_like(values)
        projected.scatter_add_(1, below, values - upper)
        return projected.scatter_add_(1, below + 1, upper)

    def of_actions(self, logits: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """What ``[B, A, Z]`` says of actions ``[B]``: ``[B, Z]``."""
        return logits.flatten(0, 1).index_select(0, self.first_actions + action)


def flatten(network: nn.Module) -> nn.Parameter:
    """Make parameters and gradients views of one parameter ``[N]`` and of its gradient."""
    parameters = list(network.parameters())
    sizes = [parameter.numel() for parameter in parameters]
    flat = nn.Parameter(torch.cat([p.detach().flatten() for p in parameters]))
    flat.grad = torch.zeros_like(flat)
    parts = zip(parameters, flat.data.split(sizes), flat.grad.split(sizes), strict=True)
    for parameter, part, gradient in parts:
        parameter.data = part.view_as(parameter)
        parameter.grad = gradient.view_as(parameter)
    return flat


def clip_gradient(weights: nn.Parameter, most: float) -> torch.Tensor:
    """Scale the gradient down to a norm of ``most``; the norm that it had."""
    assert weights.grad is not None
    norm = weights.grad.norm()
    weights.grad.mul_((most / (norm + 1e-6)).clamp_(max=1.0))
    return norm
