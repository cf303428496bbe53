"""What PPO can be told."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from gdrl_torchrl.agents.settings import check_whole_rows
from gdrl_torchrl.checks import (
    MOST_WORLDS,
    among,
    check_at_most,
    check_fields,
    within,
)


@dataclasses.dataclass
class PPOConfig:
    """PPO-clip with GAE (Schulman et al. 2017, https://arxiv.org/abs/1707.06347)."""

    actions: ClassVar[str] = "continuous"
    """Kind of actions that it needs."""

    name: str = among("ppo", ("ppo",))
    """Always ``ppo``."""
    num_worlds: int = within(16, least=1, most=MOST_WORLDS)
    """Worlds that are simulated at a time."""
    frames_per_batch: int = within(2048, least=1, most=1_000_000)
    """Steps of all worlds between updates; a multiple of ``num_worlds``."""
    num_epochs: int = within(10, least=1, most=1000)
    """Passes over each batch."""
    minibatch_size: int = within(256, least=1, most=1_000_000)
    """Steps that each update is made of."""
    learning_rate: float = within(1e-3, above=0.0, most=1.0)
    """Of Adam."""
    gamma: float = within(0.99, least=0.0, most=1.0)
    """Discount of the reward of the next step."""
    lmbda: float = within(0.95, least=0.0, most=1.0)
    """Of GAE: 0 trusts the critic, 1 the returns."""
    clip_epsilon: float = within(0.2, above=0.0, below=1.0)
    """How far an update may move the probability of an action, as a ratio."""
    entropy_coeff: float = within(0.0, least=0.0, most=100.0)
    """Weight of the policy's entropy in the loss."""
    critic_coeff: float = within(0.5, least=0.0, most=100.0)
    """Weight of the critic's error in the loss."""
    max_grad_norm: float = within(0.5, above=0.0, most=1e6)
    """Gradients that are longer are scaled to this norm."""
    normalize_advantage: bool = True
    """Whether the advantages of a minibatch get mean 0 and deviation 1."""

    def __post_init__(self) -> None:
        check_fields(self, "algorithm")
        check_whole_rows(self.frames_per_batch, self.num_worlds)
        check_at_most("algorithm", self, "minibatch_size", "frames_per_batch")
