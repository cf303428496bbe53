"""What each algorithm can be told."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from gdrl_torchrl.config.checks import check_choice, check_range
from gdrl_torchrl.plugins import with_plugins


@dataclasses.dataclass
class PPOConfig:
    """PPO-clip with GAE (Schulman et al. 2017, https://arxiv.org/abs/1707.06347)."""

    actions: ClassVar[str] = "continuous"
    """Kind of actions that it needs."""

    name: str = "ppo"
    num_worlds: int = 16
    frames_per_batch: int = 2048
    num_epochs: int = 10
    minibatch_size: int = 256
    learning_rate: float = 1e-3
    gamma: float = 0.99
    lmbda: float = 0.95
    clip_epsilon: float = 0.2
    entropy_coeff: float = 0.0
    critic_coeff: float = 0.5
    max_grad_norm: float = 0.5
    normalize_advantage: bool = True

    def __post_init__(self) -> None:
        check_choice("algorithm.name", self.name, ("ppo",))
        for name in ("num_worlds", "num_epochs", "minibatch_size", "frames_per_batch"):
            check_range(f"algorithm.{name}", getattr(self, name), least=1)
        for name in ("learning_rate", "clip_epsilon", "max_grad_norm"):
            check_range(f"algorithm.{name}", getattr(self, name), above=0.0)
        for name in ("gamma", "lmbda"):
            check_range(f"algorithm.{name}", getattr(self, name), least=0.0, most=1.0)
        for name in ("entropy_coeff", "critic_coeff"):
            check_range(f"algorithm.{name}", getattr(self, name), least=0.0)
        check_whole_rows(self.frames_per_batch, self.num_worlds)
        if self.minibatch_size > self.frames_per_batch:
            raise ValueError(
                f"algorithm.minibatch_size={self.minibatch_size} must be <= "
                f"algorithm.frames_per_batch={self.frames_per_batch}"
            )


@dataclasses.dataclass
class RainbowConfig:
    """Rainbow (Hessel et al. 2018, https://arxiv.org/abs/1710.02298)."""

    actions: ClassVar[str] = "discrete"
    """Kind of actions that it needs."""

    name: str = "rainbow"
    num_worlds: int = 16
    frames_per_batch: int = 256
    updates_per_batch: int = 8
    minibatch_size: int = 256
    learning_rate: float = 1e-3
    gamma: float = 0.99
    num_steps: int = 10
    """Steps of the return before the target network takes over."""
    num_atoms: int = 51
    target_tau: float = 0.01
    """How far the target network moves towards the agent's at every update."""
    replay_capacity: int = 100_000
    replay_alpha: float = 0.6
    replay_beta: float = 0.4
    replay_beta_increment: float = 5e-4
    """Added to beta at every update, up to 1."""
    warmup_steps: int = 2_000
    """Transitions in the buffer before the first update."""
    exploration: str = "epsilon_greedy"
    epsilon_start: float = 1.0
    epsilon_end: float = 0.02
    epsilon_decay: float = 0.99
    """Factor of epsilon at every completed episode."""
    noisy_std: float = 0.5
    """Initial scale of the noise, with ``exploration=noisy``."""
    max_grad_norm: float = 10.0

    def __post_init__(self) -> None:
        check_choice("algorithm.name", self.name, ("rainbow",))
        check_choice("algorithm.exploration", self.exploration, ("epsilon_greedy", "noisy"))
        for name in (
            "num_worlds",
            "frames_per_batch",
            "updates_per_batch",
            "minibatch_size",
            "num_steps",
            "replay_capacity",
            "warmup_steps",
        ):
            check_range(f"algorithm.{name}", getattr(self, name), least=1)
        check_range("algorithm.num_atoms", self.num_atoms, least=2)
        for name in ("learning_rate", "noisy_std", "max_grad_norm"):
            check_range(f"algorithm.{name}", getattr(self, name), above=0.0)
        check_range("algorithm.target_tau", self.target_tau, above=0.0, most=1.0)
        check_range("algorithm.replay_beta_increment", self.replay_beta_increment, least=0)
        for name in (
            "gamma",
            "replay_alpha",
            "replay_beta",
            "epsilon_start",
            "epsilon_end",
            "epsilon_decay",
        ):
            check_range(f"algorithm.{name}", getattr(self, name), least=0.0, most=1.0)
        check_whole_rows(self.frames_per_batch, self.num_worlds)
        if self.warmup_steps > self.replay_capacity:
            raise ValueError(
                f"algorithm.warmup_steps={self.warmup_steps} must be <= "
                f"algorithm.replay_capacity={self.replay_capacity}"
            )
        if self.epsilon_end > self.epsilon_start:
            raise ValueError(
                f"algorithm.epsilon_end={self.epsilon_end} must be <= "
                f"algorithm.epsilon_start={self.epsilon_start}"
            )


@dataclasses.dataclass
class GAConfig:
    """The genetic algorithm of Such et al. 2017 (https://arxiv.org/abs/1712.06567)."""

    actions: ClassVar[str] = "any"
    """Kind of actions that it needs."""

    name: str = "ga"
    population_size: int = 20
    num_parents: int = 5
    """Best members that the next generation is made of (truncation)."""
    num_trials: int = 5
    """Episodes that every member is scored on."""
    num_validated: int = 5
    """Best members that play again, to find the elite; 0 takes the first one."""
    validation_trials: int = 10
    """Episodes of each of those."""
    mutation_std: float = 0.1
    """Of the noise on every weight, in weight units."""
    fitness: str = "goals"
    num_worlds: int | None = None
    """Worlds of an evaluation; None takes one per member and trial."""

    def __post_init__(self) -> None:
        check_choice("algorithm.name", self.name, ("ga",))
        check_range("algorithm.population_size", self.population_size, least=2)
        for name in ("num_trials", "validation_trials"):
            check_range(f"algorithm.{name}", getattr(self, name), least=1)
        most = self.population_size
        check_range("algorithm.num_parents", self.num_parents, least=1, most=most)
        check_range("algorithm.num_validated", self.num_validated, least=0, most=most)
        check_range("algorithm.mutation_std", self.mutation_std, above=0.0)
        check_choice("algorithm.fitness", self.fitness, ("goals", "return"))
        if self.num_worlds is not None:
            check_range("algorithm.num_worlds", self.num_worlds, least=1)


ALGORITHMS: dict[str, type] = {
    "ppo": PPOConfig,
    "rainbow": RainbowConfig,
    "ga": GAConfig,
}
"""The dataclass of each ``conf/algorithm`` of ours."""


def algorithm_configs() -> dict[str, type]:
    """The dataclass of each algorithm, those of other packages included."""
    offered = with_plugins({}, "gdrl.algorithms")
    others = {name: algorithm.config for name, algorithm in offered.items()}
    return others | ALGORITHMS


def check_whole_rows(frames_per_batch: int, num_worlds: int) -> None:
    """Raise ValueError unless every world gives equally many frames of a batch."""
    if frames_per_batch % num_worlds:
        raise ValueError(
            f"algorithm.frames_per_batch={frames_per_batch} must be a multiple "
            f"of algorithm.num_worlds={num_worlds}"
        )
