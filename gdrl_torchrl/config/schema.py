"""One dataclass per Hydra group; values live in ``conf/``, ranges are checked here.

Fields have simple types only (what OmegaConf can hold); every object checks itself when
it is made and its errors name the field and the value.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from gdrl_torchrl.config.checks import check_choice, check_folder, check_range
from gdrl_torchrl.config.evolution import EvolutionConfig


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
    toy: bool = False
    """Make everything so small that the run only shows that it works."""
    task: Any = None
    """``name``, ``backend`` and the task's options."""
    algorithm: Any = None
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    evolution: Any = None
    """None is the seed's, with its defaults."""
    budget: BudgetConfig = dataclasses.field(
        default_factory=lambda: BudgetConfig(agent_steps=100_000)
    )
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)
    logger: LoggerConfig = dataclasses.field(default_factory=LoggerConfig)
    simulation: SimulationConfig = dataclasses.field(default_factory=SimulationConfig)

    def __post_init__(self) -> None:
        if self.evolution is None:
            self.evolution = EvolutionConfig()
        check_range("seed", self.seed, least=0)
        check_folder("name", self.name)

    @property
    def algorithm_label(self) -> str:
        """``ppo``; ``gppo`` with the seed's evaluation, ``erl_ppo`` with another one."""
        own, evolution = self.algorithm.name, self.evolution
        if not evolution.enabled:
            return own
        return f"g{own}" if evolution.name == "genetic" else f"{evolution.name}_{own}"
