"""What each algorithm can be told."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

from gdrl_torchrl.config.checks import (
    MOST_WORLDS,
    among,
    check_at_most,
    check_evaluation_worlds,
    check_fields,
    within,
)
from gdrl_torchrl.plugins import Offers, with_plugins


@dataclasses.dataclass
class PPOConfig:
    """PPO-clip with GAE (Schulman et al. 2017, https://arxiv.org/abs/1707.06347)."""

    actions: ClassVar[str] = "continuous"
    """Kind of actions that it needs."""

    name: str = among("ppo", ("ppo",))
    num_worlds: int = within(16, least=1, most=MOST_WORLDS)
    frames_per_batch: int = within(2048, least=1, most=1_000_000)
    num_epochs: int = within(10, least=1, most=1000)
    minibatch_size: int = within(256, least=1, most=1_000_000)
    learning_rate: float = within(1e-3, above=0.0, most=1.0)
    gamma: float = within(0.99, least=0.0, most=1.0)
    lmbda: float = within(0.95, least=0.0, most=1.0)
    clip_epsilon: float = within(0.2, above=0.0, below=1.0)
    entropy_coeff: float = within(0.0, least=0.0, most=100.0)
    critic_coeff: float = within(0.5, least=0.0, most=100.0)
    max_grad_norm: float = within(0.5, above=0.0, most=1e6)
    normalize_advantage: bool = True

    def __post_init__(self) -> None:
        check_fields(self, "algorithm")
        check_whole_rows(self.frames_per_batch, self.num_worlds)
        check_at_most("algorithm", self, "minibatch_size", "frames_per_batch")


@dataclasses.dataclass
class RainbowConfig:
    """Rainbow (Hessel et al. 2018, https://arxiv.org/abs/1710.02298)."""

    actions: ClassVar[str] = "discrete"
    """Kind of actions that it needs."""

    name: str = among("rainbow", ("rainbow",))
    num_worlds: int = within(16, least=1, most=MOST_WORLDS)
    frames_per_batch: int = within(256, least=1, most=1_000_000)
    collect_ahead: bool = True
    """Whether a process of its own collects the next batch during the updates."""
    updates_per_batch: int = within(8, least=1, most=10_000)
    minibatch_size: int = within(256, least=2, most=1_000_000)
    """TorchRL's sampler gives the weight of a single transition no dimension."""
    learning_rate: float = within(1e-3, above=0.0, most=1.0)
    gamma: float = within(0.99, least=0.0, most=1.0)
    num_steps: int = within(10, least=1, most=10_000)
    """Steps of the return before the target network takes over."""
    num_atoms: int = within(51, least=2, most=1000)
    target_tau: float = within(0.01, above=0.0, most=1.0)
    """How far the target network moves towards the agent's at every update."""
    replay_capacity: int = within(100_000, least=1, most=10_000_000)
    replay_alpha: float = within(0.6, least=0.0, most=1.0)
    replay_beta: float = within(0.4, least=0.0, most=1.0)
    replay_beta_increment: float = within(5e-4, least=0.0, most=1.0)
    """Added to beta at every update, up to 1."""
    warmup_steps: int = within(2_000, least=1, most=10_000_000)
    """Transitions in the buffer before the first update."""
    exploration: str = among("epsilon_greedy", ("epsilon_greedy", "noisy"))
    epsilon_start: float = within(1.0, least=0.0, most=1.0)
    epsilon_end: float = within(0.02, least=0.0, most=1.0)
    epsilon_decay: float = within(0.99, least=0.0, most=1.0)
    """Factor of epsilon at every completed episode."""
    noisy_std: float = within(0.5, above=0.0, most=10.0)
    """Initial scale of the noise, with ``exploration=noisy``."""
    max_grad_norm: float = within(10.0, above=0.0, most=1e6)

    def __post_init__(self) -> None:
        check_fields(self, "algorithm")
        check_whole_rows(self.frames_per_batch, self.num_worlds)
        check_at_most("algorithm", self, "warmup_steps", "replay_capacity")
        check_at_most("algorithm", self, "epsilon_end", "epsilon_start")


@dataclasses.dataclass
class GAConfig:
    """The genetic algorithm of Such et al. 2017 (https://arxiv.org/abs/1712.06567)."""

    actions: ClassVar[str] = "any"
    """Kind of actions that it needs."""

    name: str = among("ga", ("ga",))
    population_size: int = within(20, least=2, most=MOST_WORLDS)
    num_parents: int = within(5, least=1, most=MOST_WORLDS)
    """Best members that the next generation is made of (truncation)."""
    num_trials: int = within(5, least=1, most=10_000)
    """Episodes that every member is scored on."""
    num_validated: int = within(5, least=0, most=MOST_WORLDS)
    """Best members that play again, to find the elite; 0 takes the first one."""
    validation_trials: int = within(10, least=1, most=10_000)
    """Episodes of each of those."""
    mutation_std: float = within(0.1, above=0.0, most=10.0)
    """Of the noise on every weight, in weight units."""
    fitness: str = among("goals", ("goals", "return"))
    num_worlds: int | None = within(None, least=1, most=MOST_WORLDS)
    """Worlds of an evaluation; None takes one per member and trial."""

    def __post_init__(self) -> None:
        check_fields(self, "algorithm")
        for name in ("num_parents", "num_validated"):
            check_at_most("algorithm", self, name, "population_size")
        check_evaluation_worlds("algorithm", self, "population_size", self.population_size)


ALGORITHMS: dict[str, type] = {
    "ppo": PPOConfig,
    "rainbow": RainbowConfig,
    "ga": GAConfig,
}
"""The dataclass of each ``conf/algorithm`` of ours."""


def algorithm_configs() -> Offers:
    """The dataclass of each algorithm, those of other packages included."""
    offers = with_algorithms(ALGORITHMS)
    others = {n: offer.config for n, offer in offers.items() if n not in ALGORITHMS}
    return Offers(others | ALGORITHMS, offers.broken)


def with_algorithms(own: Mapping[str, Any]) -> Offers:
    """Ours by name, and the algorithms that other packages offer."""
    needs = ("config", "make_actor", "make_agent")
    return with_plugins(own, "gdrl.algorithms", needs=needs)


def check_whole_rows(frames_per_batch: int, num_worlds: int) -> None:
    """Raise ValueError unless every world gives equally many frames of a batch."""
    if frames_per_batch % num_worlds:
        raise ValueError(
            f"algorithm.frames_per_batch={frames_per_batch} must be a multiple "
            f"of algorithm.num_worlds={num_worlds}"
        )
