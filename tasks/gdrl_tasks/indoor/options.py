"""Options of the indoor task. Imports neither MuJoCo nor numba, which take time."""

from __future__ import annotations

import dataclasses
from typing import Literal

from gdrl_tasks.checks import check_choice, check_fields, check_times, within

STEP_LIMITS = {"paper": 500, "scatter": 500, "corridor": 1000, "trap": 500}
"""Default step limit of an episode, by arena."""

LONGEST_STEP_M = 0.11
"""Longest way of a control step: the radius of the footprint. Contacts are looked for at
the ends of steps only, and no place between them is further away than that."""


@dataclasses.dataclass(frozen=True)
class IndoorOptions:
    """Options of the indoor task."""

    arena: Literal["paper", "scatter", "corridor", "trap"] = "paper"
    """Walls and obstacles: the papers' arena, boxes at random places, a corridor, or a
    U-shaped trap before the goal."""
    actions: Literal["discrete", "continuous"] = "discrete"
    """``discrete`` drives at ``speed_m_s`` and chooses one of ``turn_rates_deg_s``;
    ``continuous`` is (speed, turn rate), each in [-1, 1]: standing still to
    ``speed_m_s``, and the largest turn rate to the right and to the left."""
    speed_m_s: float = within(0.15, above=0.0, most=0.3)
    """Largest speed."""
    turn_rates_deg_s: tuple[float, ...] = within(
        (-90.0, -45.0, 0.0, 45.0, 90.0), lengths=(2, 1000), least=-180.0, most=180.0
    )
    """Turn rates of the actions, to the left positive."""
    wheel_speed_limit: Literal["burger"] | None = None
    """``burger`` caps each wheel at 0.227 m/s, slowing both by the same factor; None
    drives as commanded, as the papers' simulators do."""
    goal_tolerance_m: float = within(0.15, least=1e-3, most=0.5)
    """Distance from the goal that counts as there."""
    num_beams: int = within(19, least=1, most=360)
    """Beams of the lidar."""
    field_of_view_deg: float = within(180.0, above=0.0, most=360.0)
    """Angle that the beams are spread over."""
    range_noise: bool = False
    """Whether ranges have the errors of the LDS-01's precision."""
    scan_hold: bool = False
    """Whether the lidar scans at 5 Hz, so that some steps observe an old scan."""
    progress_weight: float = within(10.0, least=0.0, most=1000.0)
    """Reward per metre gained towards the goal, 10 in the papers; 0 rewards ends only."""
    at_limit: Literal["terminated", "truncated"] = "terminated"
    """Whether the step limit is part of the task (-1) or cuts the episode off."""
    control_interval_s: float = within(0.12, above=0.0, most=10.0)
    """Time between actions."""
    substep_s: float = within(0.02, least=1e-4, most=0.1)
    """Time step of the simulation."""
    step_limit: int | None = within(None, least=1, most=1_000_000)
    """None takes the arena's: 500, in the corridor 1,000."""

    def __post_init__(self) -> None:
        check_choice("arena", self.arena, STEP_LIMITS)
        if self.step_limit is None:
            object.__setattr__(self, "step_limit", STEP_LIMITS[self.arena])
        check_fields(self)
        rates = self.turn_rates_deg_s
        if len(set(rates)) != len(rates):
            raise ValueError(f"turn_rates_deg_s={rates} must be different ones")
        check_times(self.control_interval_s, self.substep_s)
        way_m = self.control_interval_s * self.speed_m_s
        if way_m > LONGEST_STEP_M * (1.0 + 1e-9):
            raise ValueError(
                f"control_interval_s={self.control_interval_s} times "
                f"speed_m_s={self.speed_m_s} is {way_m:.3g} m, which must be at most "
                f"{LONGEST_STEP_M} m: contacts are looked for at the ends of steps"
            )
