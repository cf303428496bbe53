"""The presets that are certified: what the bare agent of each is trained on."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Preset:
    """A task, or a task and a regime, with the bare agent that it must be hard for."""

    name: str
    experiment: str
    """The experiment of the bare agent."""
    choices: tuple[str, ...]
    """What makes the preset, as on the command line."""
    total_steps: int
    """Budget of the bare agent."""

    @property
    def overrides(self) -> list[str]:
        """The whole of it, as on the command line."""
        return [f"experiment={self.experiment}", *self.choices]

    def command(self, seeds: int) -> str:
        """The command that trains its bare agent with seeds 0 to ``seeds`` - 1.

        In several terminals it is a queue, and what is done is skipped.
        """
        options = [
            f"name=certify_{self.name}",
            "budget.agent_steps=null",
            f"budget.total_steps={self.total_steps}",
            "simulation.num_threads=1",
            "logger.tensorboard=false",
            f"'seed=range(0,{seeds})'",
        ]
        return " ".join(["gdrl-train -m", *self.overrides, *options])


PRESETS = {
    preset.name: preset
    for preset in (
        Preset("water_calm", "ppo_water", ("task=water_calm",), 60_000),
        Preset("water_near", "ppo_water", ("task=water_near",), 60_000),
        Preset("water_precise", "ppo_water", ("task=water_precise",), 150_000),
        Preset("water_linear", "ppo_water", ("task=water_linear",), 150_000),
        Preset("water_far_current", "ppo_water", ("task=water_far_current",), 300_000),
        Preset("indoor_paper", "rainbow_indoor", ("task=indoor_paper",), 100_000),
        Preset("indoor_scatter", "rainbow_indoor", ("task=indoor_scatter",), 100_000),
        Preset("indoor_corridor", "rainbow_indoor", ("task=indoor_corridor",), 300_000),
        Preset("indoor_trap", "rainbow_indoor", ("task=indoor_trap",), 300_000),
        Preset(
            "little_data",
            "ppo_water",
            ("task=water_precise", "+regime=little_data"),
            150_000,
        ),
        Preset(
            "unstable", "rainbow_indoor", ("task=indoor_paper", "+regime=unstable"), 100_000
        ),
    )
}
"""By name. Budgets are the first guess; what was certified is in the table."""
