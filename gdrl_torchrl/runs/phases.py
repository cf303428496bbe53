"""Where the time of a training iteration goes."""

from __future__ import annotations

import time

from tensordict import TensorDictBase

from gdrl_torchrl.agents.loop import TrainingLoop

PHASES = ("collect_s", "update_s", "evaluate_s", "report_s", "steps_per_s")
"""Columns of a :class:`PhaseClock`."""


class PhaseClock:
    """Seconds of collecting, updating, evaluating populations and reporting, by row.

    Updating includes what is done to a batch before the first update, such as storing it.
    A row's ``report_s`` is what came after the row before: its writing, and saving.
    """

    def __init__(self) -> None:
        self.start(0)

    def register(self, loop: TrainingLoop) -> None:
        """Register with a loop."""
        loop.register_op("pre_steps_log", self._note_batch)
        loop.register_op("post_optim", self._note_update)

    def start(self, total_steps: int) -> None:
        """Start the clock."""
        self._ended = time.perf_counter()
        self.begin_row(total_steps)

    def begin_row(self, total_steps: int) -> None:
        """Begin a row; what came since the last one's end was reporting."""
        self._began = self._batch = self._update = time.perf_counter()
        self._steps = total_steps

    def row(self, total_steps: int) -> dict[str, float]:
        """Seconds of each phase, and steps per second, as a row ends.

        Args:
            total_steps: Environment steps so far, of agent and populations.
        """
        now = time.perf_counter()
        reported = self._began - self._ended
        seconds = {
            "collect_s": self._batch - self._began,
            "update_s": self._update - self._batch,
            "evaluate_s": now - self._update,
            "report_s": reported,
        }
        taken = now - self._ended
        self._ended = now
        rounded = {name: round(value, 6) for name, value in seconds.items()}
        return rounded | {"steps_per_s": round((total_steps - self._steps) / taken, 1)}

    def _note_batch(self, batch: TensorDictBase) -> None:
        self._batch = self._update = time.perf_counter()

    def _note_update(self) -> None:
        self._update = time.perf_counter()
