"""What Rainbow can be told."""

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
class RainbowConfig:
    """Rainbow (Hessel et al. 2018, https://arxiv.org/abs/1710.02298)."""

    actions: ClassVar[str] = "discrete"
    """Kind of actions that it needs."""
    has_critic: ClassVar[bool] = False
    """Whether there is a critic beside the policy."""

    name: str = among("rainbow", ("rainbow",))
    """Always ``rainbow``."""
    num_worlds: int = within(16, least=1, most=MOST_WORLDS)
    """Worlds that are simulated at a time."""
    frames_per_batch: int = within(256, least=1, most=1_000_000)
    """Steps of all worlds between updates; a multiple of ``num_worlds``."""
    collect_ahead: bool = True
    """Whether a process of its own collects the next batch during the updates."""
    updates_per_batch: int = within(8, least=1, most=10_000)
    """Updates after each batch."""
    minibatch_size: int = within(256, least=2, most=1_000_000)
    """TorchRL's sampler gives the weight of a single transition no dimension."""
    learning_rate: float = within(1e-3, above=0.0, most=1.0)
    """Of Adam."""
    gamma: float = within(0.99, least=0.0, most=1.0)
    """Discount of the reward of the next step."""
    num_steps: int = within(10, least=1, most=10_000)
    """Steps of the return before the target network takes over."""
    num_atoms: int = within(51, least=2, most=1000)
    """Values that the distribution of the return is spread over."""
    target_tau: float = within(0.01, above=0.0, most=1.0)
    """How far the target network moves towards the agent's at every update."""
    replay_capacity: int = within(100_000, least=1, most=10_000_000)
    """Transitions that the buffer holds."""
    replay_alpha: float = within(0.6, least=0.0, most=1.0)
    """How much priorities count when transitions are drawn; 0 draws all alike."""
    replay_beta: float = within(0.4, least=0.0, most=1.0)
    """How much of the bias of priorities is corrected at the start."""
    replay_beta_increment: float = within(5e-4, least=0.0, most=1.0)
    """Added to beta at every update, up to 1."""
    warmup_steps: int = within(2_000, least=1, most=10_000_000)
    """Transitions in the buffer before the first update."""
    exploration: str = among("epsilon_greedy", ("epsilon_greedy", "noisy"))
    """By random actions (``epsilon_greedy``) or by networks with noise (``noisy``)."""
    epsilon_start: float = within(1.0, least=0.0, most=1.0)
    """Share of random actions at the start."""
    epsilon_end: float = within(0.02, least=0.0, most=1.0)
    """Share of random actions that is left at last."""
    epsilon_decay: float = within(0.99, least=0.0, most=1.0)
    """Factor of epsilon at every completed episode."""
    noisy_std: float = within(0.5, above=0.0, most=10.0)
    """Initial scale of the noise, with ``exploration=noisy``."""
    max_grad_norm: float = within(10.0, above=0.0, most=1e6)
    """Gradients that are longer are scaled to this norm."""

    def __post_init__(self) -> None:
        check_fields(self, "algorithm")
        check_whole_rows(self.frames_per_batch, self.num_worlds)
        check_at_most("algorithm", self, "warmup_steps", "replay_capacity")
        check_at_most("algorithm", self, "epsilon_end", "epsilon_start")
