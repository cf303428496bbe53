"""The presets that are certified: what the bare agent of each is trained on."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Preset:
    """A task, or a task and a regime, with the bare agent that it must be hard for."""

    name: str
    experiment: str
    """The experiment of the bare agent."""
    tuned: str
    """What a search has found for it."""
    choices: tuple[str, ...]
    """What makes the preset, as on the command line."""
    total_steps: int
    """Budget of the bare agent."""

    @property
    def overrides(self) -> list[str]:
        """The whole of it, as on the command line."""
        return [f"experiment={self.experiment}", self.tuned, *self.choices]

    def command(self, seeds: int) -> str:
        """The command that trains its bare agent with so many seeds, from 200 on.

        No search and no study has these seeds, or it would choose what it is judged on.
        In several terminals it is a queue, and what is done is skipped.
        """
        options = [
            f"name=certify_{self.name}",
            "budget.agent_steps=null",
            f"budget.total_steps={self.total_steps}",
            "simulation.num_threads=1",
            "logger.tensorboard=false",
            f"'seed=range(200,{200 + seeds})'",
        ]
        return " ".join(["gdrl-train -m", *self.overrides, *options])


WATER = ("ppo_water", "+tuned=ppo_water")
INDOOR = ("rainbow_indoor", "+tuned=rainbow_indoor")

PRESETS = {
    preset.name: preset
    for preset in (
        Preset("water_calm", *WATER, ("task=water_calm",), 90_000),
        Preset("water_near", *WATER, ("task=water_near",), 60_000),
        Preset("water_precise", *WATER, ("task=water_precise",), 120_000),
        Preset("water_linear", *WATER, ("task=water_linear",), 150_000),
        Preset("water_far_current", *WATER, ("task=water_far_current",), 300_000),
        Preset("indoor_paper", *INDOOR, ("task=indoor_paper",), 50_000),
        Preset("indoor_sparse", *INDOOR, ("task=indoor_sparse",), 100_000),
        Preset("indoor_scatter", *INDOOR, ("task=indoor_scatter",), 50_000),
        Preset("indoor_scatter_sparse", *INDOOR, ("task=indoor_scatter_sparse",), 80_000),
        Preset("indoor_corridor", *INDOOR, ("task=indoor_corridor",), 100_000),
        Preset("indoor_trap", *INDOOR, ("task=indoor_trap",), 100_000),
        Preset(
            "little_data",
            *WATER,
            ("task=water_precise", "+regime=little_data"),
            150_000,
        ),
        Preset("one_world", *INDOOR, ("task=indoor_paper", "+regime=one_world"), 50_000),
        Preset("unstable", *INDOOR, ("task=indoor_paper", "+regime=unstable"), 50_000),
    )
}
"""By name. Budgets are those that the table was measured with. ``water_near`` failed before
its bare agent was trained."""
