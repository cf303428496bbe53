"""One dataclass per Hydra group; values live in ``conf/``, ranges are checked here.

Fields have simple types only (what OmegaConf can hold); every object checks itself when
it is made and its errors name the field and the value.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from gdrl_torchrl.evolution.mutation import MUTATIONS
from gdrl_torchrl.evolution.selection import TIE_RULES


@dataclasses.dataclass
class NetworkConfig:
    """Networks of the agent."""

    actor_cells: list[int] = dataclasses.field(default_factory=lambda: [32, 32])
    critic_cells: list[int] = dataclasses.field(default_factory=lambda: [64, 64])
    critic_sees_time: bool = True
    """Whether the critic reads the time left, which the policy does not see."""
    activation: str = "tanh"
    initial_std: float = 1.0
    """Of the policy before squashing, for continuous actions."""

    def __post_init__(self) -> None:
        for name in ("actor_cells", "critic_cells"):
            cells = getattr(self, name)
            if not cells or any(width < 1 for width in cells):
                raise ValueError(f"network.{name}={cells} must be widths >= 1")
        check_choice("network.activation", self.activation, ("tanh", "relu"))
        check_range("network.initial_std", self.initial_std, above=0.0)


@dataclasses.dataclass
class PPOConfig:
    """PPO-clip with GAE (Schulman et al. 2017, https://arxiv.org/abs/1707.06347)."""

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


ALGORITHMS: dict[str, type] = {"ppo": PPOConfig, "rainbow": RainbowConfig}


@dataclasses.dataclass
class EvolutionConfig:
    """The genetic evaluation of the agent (Marchesini and Farinelli, AAMAS 2020)."""

    enabled: bool = True
    num_children: int = 10
    num_trials: int = 10
    """Episodes that every member is scored on."""
    period_episodes: int = 50
    """Completed training episodes between evaluations; not given by the papers."""
    mutation: str = "bernoulli"
    mut_v: float = 0.1
    mut_v_is: str = "std"
    rates: list[float] = dataclasses.field(default_factory=lambda: [0.75, 0.4, 0.1])
    thresholds: list[float] = dataclasses.field(default_factory=lambda: [0.4, 0.8])
    """Success rates at which the next of ``rates`` begins; not given by the papers."""
    window_episodes: int = 100
    fitness: str = "goals"
    tie_rule: str = "return_then_parent"
    optimizer_on_switch: str = "keep"
    """``keep`` the optimiser's moments or ``reset`` those of the actor."""
    critic_on_switch: str = "keep"
    """``keep`` the parent's critic or ``reset`` it to new weights."""
    target_tau: float = 0.1
    """How far a target network moves towards the new agent on a switch."""
    experience_share: float = 0.1
    """Share of an evaluation's transitions that enters the agent's replay buffer on a
    switch; 0 shares none."""
    num_worlds: int | None = None
    """Worlds of the evaluation; None takes one per member and trial."""

    def __post_init__(self) -> None:
        for name in ("num_children", "num_trials", "period_episodes", "window_episodes"):
            check_range(f"evolution.{name}", getattr(self, name), least=1)
        if self.num_worlds is not None:
            check_range("evolution.num_worlds", self.num_worlds, least=1)
        check_range("evolution.mut_v", self.mut_v, least=0.0)
        for name in ("target_tau", "experience_share"):
            check_range(f"evolution.{name}", getattr(self, name), least=0.0, most=1.0)
        check_choice("evolution.mutation", self.mutation, MUTATIONS)
        check_choice("evolution.mut_v_is", self.mut_v_is, ("std", "variance"))
        check_choice("evolution.fitness", self.fitness, ("goals", "return"))
        check_choice("evolution.tie_rule", self.tie_rule, TIE_RULES)
        for name in ("optimizer_on_switch", "critic_on_switch"):
            check_choice(f"evolution.{name}", getattr(self, name), ("keep", "reset"))
        for rate in self.rates:
            check_range("evolution.rates", rate, least=0.0, most=1.0)
        for threshold in self.thresholds:
            check_range("evolution.thresholds", threshold, least=0.0, most=1.0)
        if len(self.rates) != len(self.thresholds) + 1:
            raise ValueError(
                f"evolution.rates={self.rates} must have one entry more than "
                f"evolution.thresholds={self.thresholds}"
            )
        if self.thresholds != sorted(set(self.thresholds)):
            raise ValueError(f"evolution.thresholds={self.thresholds} must increase")


@dataclasses.dataclass
class BudgetConfig:
    """When training ends: the first budget that is reached; None is no limit."""

    agent_steps: int | None = None
    total_steps: int | None = None
    wall_s: float | None = None

    def __post_init__(self) -> None:
        for name in ("agent_steps", "total_steps", "wall_s"):
            value = getattr(self, name)
            if value is not None:
                check_range(f"budget.{name}", value, above=0.0)
        if self.agent_steps is None and self.total_steps is None and self.wall_s is None:
            raise ValueError(
                "budget: one of agent_steps, total_steps and wall_s must be given"
            )


@dataclasses.dataclass
class EvaluationConfig:
    """Evaluation on held-out worlds at the end of training."""

    episodes: int = 500
    seed: int = 0
    """Seed of the held-out worlds: the same worlds for runs of all seeds."""
    num_worlds: int = 100

    def __post_init__(self) -> None:
        check_range("evaluation.episodes", self.episodes, least=1)
        check_range("evaluation.seed", self.seed, least=0)
        check_range("evaluation.num_worlds", self.num_worlds, least=1)


@dataclasses.dataclass
class CheckpointConfig:
    """How often training is saved."""

    interval_s: float = 30.0
    keep: int = 2

    def __post_init__(self) -> None:
        check_range("checkpoint.interval_s", self.interval_s, least=0.0)
        check_range("checkpoint.keep", self.keep, least=1)


@dataclasses.dataclass
class LoggerConfig:
    """What is written beside ``metrics.csv``."""

    tensorboard: bool = True
    video_episodes: int = 4
    """Held-out episodes in the video; 0 makes none."""

    def __post_init__(self) -> None:
        check_range("logger.video_episodes", self.video_episodes, least=0)


@dataclasses.dataclass
class SimulationConfig:
    """How the simulation runs; results do not depend on it."""

    num_threads: int = 0
    """Threads of the simulation; 0 takes one per processor."""

    def __post_init__(self) -> None:
        check_range("simulation.num_threads", self.num_threads, least=0)


@dataclasses.dataclass
class ExperimentConfig:
    """A whole run."""

    name: str = "experiment"
    seed: int = 0
    runs_dir: str = "runs"
    force: bool = False
    """Go on with a run directory that another version of the code has written."""
    task: Any = None
    """``name``, ``backend`` and the task's options."""
    algorithm: Any = None
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    evolution: EvolutionConfig = dataclasses.field(default_factory=EvolutionConfig)
    budget: BudgetConfig = dataclasses.field(
        default_factory=lambda: BudgetConfig(agent_steps=100_000)
    )
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)
    logger: LoggerConfig = dataclasses.field(default_factory=LoggerConfig)
    simulation: SimulationConfig = dataclasses.field(default_factory=SimulationConfig)

    def __post_init__(self) -> None:
        check_range("seed", self.seed, least=0)
        if self.name in ("", ".", "..") or "/" in self.name:
            raise ValueError(f"name={self.name!r} must be a folder's name")

    @property
    def algorithm_label(self) -> str:
        """``ppo``, or ``gppo`` with the genetic evaluation."""
        return ("g" if self.evolution.enabled else "") + self.algorithm.name


def check_whole_rows(frames_per_batch: int, num_worlds: int) -> None:
    """Raise ValueError unless every world gives equally many frames of a batch."""
    if frames_per_batch % num_worlds:
        raise ValueError(
            f"algorithm.frames_per_batch={frames_per_batch} must be a multiple "
            f"of algorithm.num_worlds={num_worlds}"
        )


def check_choice(name: str, value: Any, choices: Any) -> None:
    """Raise ValueError unless a value is one of the choices."""
    if value not in choices:
        raise ValueError(f"{name}={value!r} must be one of {sorted(choices)}")


def check_range(
    name: str,
    value: float,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
) -> None:
    """Raise ValueError unless ``above < value``, ``least <= value <= most``, finite."""
    if not (above < value and least <= value <= most and math.isfinite(value)):
        bounds = [f"> {above:g}"] if above > -math.inf else []
        bounds += [f">= {least:g}"] if least > -math.inf else []
        bounds += [f"<= {most:g}"] if most < math.inf else []
        raise ValueError(f"{name}={value} must be {' and '.join(bounds) or 'finite'}")
