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


@dataclasses.dataclass
class RainbowConfig:
    """Rainbow (Hessel et al. 2018, https://arxiv.org/abs/1710.02298)."""

    actions: ClassVar[str] = "discrete"
    """Kind of actions that it needs."""

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


@dataclasses.dataclass
class GAConfig:
    """The genetic algorithm of Such et al. 2017 (https://arxiv.org/abs/1712.06567)."""

    actions: ClassVar[str] = "any"
    """Kind of actions that it needs."""

    name: str = among("ga", ("ga",))
    """Always ``ga``."""
    population_size: int = within(20, least=2, most=MOST_WORLDS)
    """Members of a generation."""
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
    """What members are scored by: ``goals`` that they reach, or the mean ``return``."""
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
