"""Options of the water task. Imports neither MuJoCo nor numba, which take time."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal

from gdrl_tasks.checks import among, check_choice, check_fields, check_times, within
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

_PROGRESS_WEIGHTS = {"sparse": 0.0, "dense": 1.0}

EXTRA_OBSERVATIONS: dict[str, tuple[int, float, float]] = {
    "velocity": (3, -10.0, 10.0),
    "roll": (1, -math.pi, math.pi),
    "time_left": (1, 0.0, 1.0),
}


@dataclasses.dataclass(frozen=True)
class WaterOptions:
    """Options of the water task; ``None`` takes the value that ``difficulty`` has."""

    difficulty: Literal["near", "far"] = "near"
    """What goal and sea are unless they are given."""
    goal_distance_m: tuple[float, float] | None = within(
        None, lengths=(2, 2), above=0.0, most=1e4
    )
    """Range of the goal's distance from the start; it may have any bearing."""
    goal_tolerance_m: float | None = within(None, least=1e-3, most=1e4)
    """Distance from the goal that counts as there."""
    sea: Literal["calm", "lake", "rough"] | None = None
    """How high the waves are."""
    significant_wave_height_m: float | None = within(None, least=0.0, most=2.0)
    """Fixes Hs in every episode; ``None`` draws it from the sea's wind and fetch."""
    peak_period_s: float | None = within(
        None, least=waves.SHORTEST_PERIOD_S, most=waves.LONGEST_PERIOD_S
    )
    """Fixes Tp in every episode; ``None`` draws it from the sea's wind and fetch."""
    current_m_s: float = within(0.0, least=0.0, most=5.0)
    """Speed of a steady current; its direction is drawn per episode."""
    reward: Literal["sparse", "dense"] = "sparse"
    """What ``progress_weight`` is unless it is given: 0, or 1 if ``dense``."""
    progress_weight: float | None = within(None, least=0.0, most=1000.0)
    """Reward per metre gained towards the goal; 0 rewards ends only."""
    at_limit: Literal["terminated", "truncated"] = "terminated"
    """Whether the step limit is part of the task (-1) or cuts the episode off."""
    actions: Literal["continuous", "discrete"] = "continuous"
    """Two thrusts from -1 to 1, or one of seven pairs of them."""
    dead_zone_compensated: bool = False
    """Whether small thrusts are mapped past the thrusters' dead zone."""
    extra_observations: tuple[str, ...] = among((), EXTRA_OBSERVATIONS)
    """Any of ``velocity`` (surge, sway, yaw rate), ``roll``, ``time_left``."""
    control_interval_s: float = within(0.25, above=0.0, most=1.0)
    """Time between actions. A goal is looked for along a straight line in it; in a longer
    step the way bends more."""
    substep_s: float = within(0.03125, least=1e-4, most=0.1)
    """Time step of the simulation."""
    step_limit: int = within(160, least=1, most=1_000_000)
    """Control steps that an episode takes at most."""
    wave_components: int = within(12, least=1, most=1000)
    """Sine waves that the sea is the sum of."""

    def __post_init__(self) -> None:
        check_choice("difficulty", self.difficulty, DIFFICULTIES)
        for name, value in DIFFICULTIES[self.difficulty].items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        check_fields(self)
        if self.progress_weight is None:
            object.__setattr__(self, "progress_weight", _PROGRESS_WEIGHTS[self.reward])
        check_times(self.control_interval_s, self.substep_s)
        self._check_goal()
        self._check_steepness()

    def _check_goal(self) -> None:
        assert self.goal_distance_m is not None
        assert self.goal_tolerance_m is not None
        low, high = map(float, self.goal_distance_m)
        object.__setattr__(self, "goal_distance_m", (low, high))
        if low > high:
            raise ValueError(f"goal_distance_m={(low, high)} must be (nearest, farthest)")
        if self.goal_tolerance_m >= low:
            raise ValueError(
                f"goal_tolerance_m={self.goal_tolerance_m} must be below the nearest goal, "
                f"goal_distance_m={self.goal_distance_m}"
            )

    def _check_steepness(self) -> None:
        """Raise ValueError if an episode could have a sea steeper than the limit."""
        assert self.sea is not None
        height, period = self.significant_wave_height_m, self.peak_period_s
        if height is None and period is None:
            # Wind and fetch give height and period together.
            return
        heights, periods = waves.sea_range(self.sea)
        highest = heights[1] if height is None else height
        shortest = periods[0] if period is None else period
        steepness = highest / waves.wavelength(shortest)
        if steepness <= waves.STEEPEST:
            return
        names = [
            f"heights up to {highest:.2f} m of sea={self.sea!r}"
            if height is None
            else f"significant_wave_height_m={height}",
            f"peak periods from {shortest:.2f} s of sea={self.sea!r}"
            if period is None
            else f"peak_period_s={period}",
        ]
        # Rounded to the safe side.
        allowed = waves.STEEPEST * waves.wavelength(shortest)
        allowed = math.floor(1e3 * allowed) / 1e3
        least = math.sqrt(highest / (waves.STEEPEST * waves.wavelength(1.0)))
        least = math.ceil(1e2 * least) / 1e2
        if height is None:
            names.reverse()
        raise ValueError(
            f"{names[0]} with {names[1]} is a steepness (height over wavelength) of "
            f"{steepness:.3f}, which must be at most 1/{1.0 / waves.STEEPEST:.0f}; set "
            f"significant_wave_height_m to {allowed} or less, or peak_period_s to {least} "
            "or more"
        )
