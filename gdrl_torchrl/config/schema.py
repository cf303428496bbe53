"""One dataclass per Hydra group; values live in ``conf/``, ranges are checked here.

Fields have simple types only (what OmegaConf can hold); every object checks itself when
it is made and its errors name the field and the value.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from gdrl_torchrl.agents.settings import NetworkConfig
from gdrl_torchrl.checks import (
    MOST_EPISODES,
    MOST_SEED,
    MOST_STEPS,
    MOST_WORLDS,
    among,
    check_fields,
    check_folder,
    within,
)
from gdrl_torchrl.evolution.settings import EvolutionConfig
from gdrl_torchrl.labels import algorithm_label


@dataclasses.dataclass
class BudgetConfig:
    """When training ends: the first budget that is reached; None is no limit."""

    agent_steps: int | None = within(None, least=1, most=MOST_STEPS)
    """Steps of the agent's own worlds."""
    total_steps: int | None = within(None, least=1, most=MOST_STEPS)
    """Steps of the agent's and of the population's worlds."""
    wall_s: float | None = within(None, above=0.0, most=1e8)
    """Seconds of training."""

    def __post_init__(self) -> None:
        check_fields(self, "budget")
        if self.agent_steps is None and self.total_steps is None and self.wall_s is None:
            raise ValueError(
                "budget.agent_steps=None, budget.total_steps=None, budget.wall_s=None: one "
                "must be given"
            )

    def is_spent(self, counters: Mapping[str, Any]) -> bool:
        """Whether one of the budgets is reached.

        Examples:
            >>> counters = {"agent_steps": 10, "total_steps": 30, "wall_s": 1.0}
            >>> BudgetConfig(agent_steps=11).is_spent(counters)
            False
            >>> BudgetConfig(agent_steps=11, total_steps=30).is_spent(counters)
            True
        """
        limits = dataclasses.asdict(self).items()
        return any(limit is not None and counters[name] >= limit for name, limit in limits)


@dataclasses.dataclass
class EvaluationConfig:
    """Evaluation on held-out worlds at the end of training."""

    episodes: int = within(500, least=1, most=MOST_EPISODES)
    """Held-out episodes."""
    seed: int = within(0, least=0, most=MOST_SEED)
    """Seed of the held-out worlds: the same worlds for runs of all seeds."""
    num_worlds: int = within(100, least=1, most=MOST_WORLDS)
    """Worlds that are simulated at a time."""
    num_policies: int = within(0, least=0, most=1000)
    """Policies that are kept at equal steps of budget.total_steps and evaluated too, for a
    curve of held-out success."""

    def __post_init__(self) -> None:
        check_fields(self, "evaluation")


@dataclasses.dataclass
class CheckpointConfig:
    """How often training is saved."""

    interval_s: float = within(30.0, least=0.0, most=1e8)
    """Seconds between saves; 0 saves after every iteration."""
    keep: int = within(2, least=1, most=10_000)
    """How many of the last saves are kept."""

    def __post_init__(self) -> None:
        check_fields(self, "checkpoint")


@dataclasses.dataclass
class LoggerConfig:
    """What is written beside ``metrics.csv``."""

    tensorboard: bool = True
    """Whether curves are written for TensorBoard too."""
    figures: bool = True
    """Whether the learning curve and trajectories are drawn at the end: three seconds."""
    video_episodes: int = within(0, least=0, most=1000)
    """Held-out episodes in a video at the end; 0 makes none: gdrl-video does later."""

    def __post_init__(self) -> None:
        check_fields(self, "logger")


@dataclasses.dataclass
class SimulationConfig:
    """How the simulation runs; results do not depend on it."""

    num_threads: int = within(0, least=0, most=1024)
    """Threads of the simulation; 0 takes one per allowed processor."""

    def __post_init__(self) -> None:
        check_fields(self, "simulation")


@dataclasses.dataclass
class FaultsConfig:
    """What happens when numbers are no longer numbers."""

    on_non_finite_update: str = among("stop", ("stop", "skip"))
    """A loss or a gradient that is not finite: ``stop`` ends training with the minibatch
    in a file, ``skip`` makes no update."""
    most_files: int = within(20, least=0, most=10_000)
    """Most files about faults that a run directory gets."""

    def __post_init__(self) -> None:
        check_fields(self, "faults")


@dataclasses.dataclass
class ExperimentConfig:
    """A whole run."""

    name: str = "experiment"
    """Folder of the run in ``runs_dir``; experiments and sweeps have names of their own."""
    seed: int = within(0, least=0, most=MOST_SEED)
    """Seed of everything that training draws."""
    runs_dir: str = "runs"
    """Folder of all runs."""
    force: bool = False
    """Go on with a run directory whose results or files are of another version."""
    toy: bool = False
    """Make everything so small that the run only shows that it works."""
    task: Any = None
    """``name``, ``backend`` and the task's options."""
    algorithm: Any = None
    """How the agent learns."""
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    """Networks of the agent."""
    evolution: Any = None
    """None is the seed's, with its defaults."""
    budget: BudgetConfig = dataclasses.field(
        default_factory=lambda: BudgetConfig(agent_steps=100_000)
    )
    """When training ends."""
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    """The evaluation at the end."""
    checkpoint: CheckpointConfig = dataclasses.field(default_factory=CheckpointConfig)
    """How often training is saved."""
    logger: LoggerConfig = dataclasses.field(default_factory=LoggerConfig)
    """What else is written."""
    simulation: SimulationConfig = dataclasses.field(default_factory=SimulationConfig)
    """How the simulation runs."""
    faults: FaultsConfig = dataclasses.field(default_factory=FaultsConfig)
    """What happens when numbers are no longer numbers."""

    def __post_init__(self) -> None:
        if self.evolution is None:
            self.evolution = EvolutionConfig()
        check_fields(self)
        check_folder("name", self.name)

    @property
    def algorithm_label(self) -> str:
        """``ppo``; ``gppo`` with the seed's evaluation, ``erl_ppo`` with another one."""
        evolution = self.evolution.name if self.evolution.enabled else None
        return algorithm_label(self.algorithm.name, evolution)
