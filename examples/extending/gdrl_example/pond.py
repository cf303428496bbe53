"""A smaller water: near goals, no waves, and a choice of how wide it is."""

from __future__ import annotations

import dataclasses

from gdrl_tasks.registry import RegisteredTask
from gdrl_tasks.water.options import WaterOptions
from gdrl_tasks.water.task import WaterTask


@dataclasses.dataclass(frozen=True)
class PondOptions:
    """Options of the pond."""

    width_m: float = 4.0
    step_limit: int = 60

    def __post_init__(self) -> None:
        if not 2.0 < self.width_m <= 20.0:
            raise ValueError(f"width_m={self.width_m} must be in (2, 20]")


class PondTask(WaterTask):
    """The vessel of the water task, in a pond."""

    name = "pond"

    def __init__(self, options: PondOptions | None = None) -> None:
        self.pond = options or PondOptions()
        super().__init__(
            WaterOptions(
                sea="calm",
                goal_distance_m=(1.0, 0.5 * self.pond.width_m),
                goal_tolerance_m=0.5,
                step_limit=self.pond.step_limit,
            )
        )


POND = RegisteredTask("pond", PondOptions, PondTask, tags=("continuous",))
