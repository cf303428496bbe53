"""What the water task can be told. Imports neither MuJoCo nor numba, which cost time."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal

from gdrl_tasks.checks import (
    as_tuple,
    check_choice,
    check_count,
    check_flag,
    check_range,
    check_times,
)
from gdrl_tasks.water import waves

DIFFICULTIES: dict[str, dict[str, Any]] = {
    "near": {
        "goal_distance_m": (2.0, 6.0),
        "goal_tolerance_m": 0.3,
        "sea": "lake",
    },
    "far": {
        "goal_distance_m": (5.0, 15.0),
        "goal_tolerance_m": 0.15,
        "sea": "rough",
    },
}

EXTRA_OBSERVATIONS: dict[str, tuple[int, float, float]] = {
    "velocity": (3, -10.0, 10.0),
    "roll": (1, -math.pi, math.pi),
    "time_left": (1, 0.0, 1.0),
}


@dataclasses.dataclass(frozen=True)
class WaterOptions:
    """Options of the water task; ``None`` means what ``difficulty`` says."""

    difficulty: Literal["near", "far"] = "near"
    goal_distance_m: tuple[float, float] | None = None
    """Range of the goal's distance from the start; its bearing is anything."""
    goal_tolerance_m: float | None = None
    sea: Literal["calm", "lake", "rough"] | None = None
    significant_wave_height_m: float | None = None
    """Fixes Hs in every episode; ``None`` draws it from the sea's lake conditions."""
    peak_period_s: float | None = None
    """Fixes Tp in every episode; ``None`` draws it from the sea's lake conditions."""
    current_m_s: float = 0.0
    """Speed of a steady current; its direction is drawn per episode."""
    reward: Literal["sparse", "dense"] = "sparse"
    """``dense`` adds progress towards the goal in metres."""
    at_limit: Literal["terminated", "truncated"] = "terminated"
    """Whether the step limit is part of the task (-1) or cuts the episode off."""
    actions: Literal["continuous", "discrete"] = "continuous"
    dead_zone_compensated: bool = False
    extra_observations: tuple[str, ...] = ()
    """Any of ``velocity`` (surge, sway, yaw rate), ``roll``, ``time_left``."""
    control_interval_s: float = 0.25
    substep_s: float = 0.03125
    step_limit: int = 160
    wave_components: int = 12

    def __post_init__(self) -> None:
        check_choice("difficulty", self.difficulty, DIFFICULTIES)
        for name, value in DIFFICULTIES[self.difficulty].items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        check_choice("reward", self.reward, ("sparse", "dense"))
        check_choice("at_limit", self.at_limit, ("terminated", "truncated"))
        check_choice("actions", self.actions, ("continuous", "discrete"))
        extras = as_tuple("extra_observations", self.extra_observations)
        object.__setattr__(self, "extra_observations", extras)
        for name in extras:
            check_choice("extra_observations", name, EXTRA_OBSERVATIONS)
        check_flag("dead_zone_compensated", self.dead_zone_compensated)
        self._check_goal()
        self._check_sea()
        check_times(self.control_interval_s, self.substep_s, self.step_limit)

    def _check_goal(self) -> None:
        distances = as_tuple("goal_distance_m", self.goal_distance_m)
        for distance in distances:
            check_range("goal_distance_m", distance, above=0.0, most=1e4)
        if len(distances) != 2 or distances[0] > distances[1]:
            raise ValueError(f"goal_distance_m={distances} must be (nearest, farthest)")
        low, high = float(distances[0]), float(distances[1])
        object.__setattr__(self, "goal_distance_m", (low, high))
        tolerance = self.goal_tolerance_m
        check_range("goal_tolerance_m", tolerance, above=0.0)
        if tolerance is not None and tolerance >= low:
            raise ValueError(
                f"goal_tolerance_m={tolerance} must be below the nearest "
                f"goal, goal_distance_m={self.goal_distance_m}"
            )

    def _check_sea(self) -> None:
        check_choice("sea", self.sea, waves.SEAS)
        if self.significant_wave_height_m is not None:
            height = self.significant_wave_height_m
            check_range("significant_wave_height_m", height, least=0.0, most=2.0)
        if self.peak_period_s is not None:
            check_range("peak_period_s", self.peak_period_s, least=0.4, most=1e5)
        check_range("current_m_s", self.current_m_s, least=0.0, most=5.0)
        check_count("wave_components", self.wave_components, most=1000)
