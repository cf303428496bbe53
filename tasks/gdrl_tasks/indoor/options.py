"""What the indoor task can be told. Imports neither MuJoCo nor numba, which cost time."""

from __future__ import annotations

import dataclasses
from typing import Literal

from gdrl_tasks.checks import (
    as_tuple,
    check_choice,
    check_count,
    check_flag,
    check_range,
    check_times,
)

STEP_LIMITS = {"paper": 500, "scatter": 500, "corridor": 1000}
"""Control steps that an episode takes at most unless told otherwise, by arena."""


@dataclasses.dataclass(frozen=True)
class IndoorOptions:
    """Options of the indoor task."""

    arena: Literal["paper", "scatter", "corridor"] = "paper"
    actions: Literal["discrete", "continuous"] = "discrete"
    """``discrete`` drives at ``speed_m_s`` and chooses one of ``turn_rates_deg_s``;
    ``continuous`` is (speed, turn rate), each in [-1, 1]: standing still to
    ``speed_m_s``, and the largest turn rate to the right and to the left."""
    speed_m_s: float = 0.15
    turn_rates_deg_s: tuple[float, ...] = (-90.0, -45.0, 0.0, 45.0, 90.0)
    wheel_speed_limit: Literal["burger"] | None = None
    """``burger`` caps each wheel at 0.227 m/s, slowing both by the same factor; None
    drives as commanded, as the papers' simulators do."""
    goal_tolerance_m: float = 0.15
    num_beams: int = 19
    field_of_view_deg: float = 180.0
    range_noise: bool = False
    """Whether ranges have the errors of the LDS-01's precision."""
    scan_hold: bool = False
    """Whether the lidar scans at 5 Hz, so that some steps see an old scan."""
    at_limit: Literal["terminated", "truncated"] = "terminated"
    """Whether the step limit is part of the task (-1) or cuts the episode off."""
    control_interval_s: float = 0.12
    substep_s: float = 0.02
    step_limit: int | None = None
    """None takes the arena's: 500, in the corridor 1,000."""

    def __post_init__(self) -> None:
        check_choice("arena", self.arena, STEP_LIMITS)
        check_choice("actions", self.actions, ("discrete", "continuous"))
        check_choice("at_limit", self.at_limit, ("terminated", "truncated"))
        check_range("speed_m_s", self.speed_m_s, above=0.0, most=0.3)
        rates = as_tuple("turn_rates_deg_s", self.turn_rates_deg_s)
        object.__setattr__(self, "turn_rates_deg_s", rates)
        for rate in rates:
            check_range("turn_rates_deg_s", rate, least=-180.0, most=180.0)
        if len(set(rates)) != len(rates) or len(rates) < 2:
            raise ValueError(f"turn_rates_deg_s={rates} must be two different ones or more")
        if self.wheel_speed_limit is not None:
            check_choice("wheel_speed_limit", self.wheel_speed_limit, ("burger",))
        check_range("goal_tolerance_m", self.goal_tolerance_m, above=0.0, most=0.5)
        check_count("num_beams", self.num_beams, most=360)
        check_range("field_of_view_deg", self.field_of_view_deg, above=0.0, most=360.0)
        check_flag("range_noise", self.range_noise)
        check_flag("scan_hold", self.scan_hold)
        if self.step_limit is None:
            object.__setattr__(self, "step_limit", STEP_LIMITS[self.arena])
        check_times(self.control_interval_s, self.substep_s, self.step_limit)
