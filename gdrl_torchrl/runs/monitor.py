"""What a run reports while it trains, when it saves, and when it ends."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.record.loggers import Logger
from tqdm import tqdm

from gdrl_torchrl import keys
from gdrl_torchrl.agents.loop import TrainingLoop
from gdrl_torchrl.agents.update import Update
from gdrl_torchrl.config.schema import BudgetConfig
from gdrl_torchrl.evolution.hooks.base import (
    Evolution,
    GeneticEvaluation,
    PopulationCounts,
)
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.files.faults import FaultFiles
from gdrl_torchrl.files.metrics import MetricsTable
from gdrl_torchrl.runs.phases import PHASES, PhaseClock
from gdrl_torchrl.runs.signals import StopSignals

COLUMNS = (
    "agent_steps",
    "population_steps",
    "total_steps",
    "wall_s",
    "episodes",
    "success_rate",
    "return_mean",
    "evaluations",
    "switches",
    "without_fitness",
    "diverged",
    "skipped_updates",
    "mut_p",
    "fitness_best",
    "fitness_parent",
    "fitness_mean",
    "winner",
    "switched",
)
"""Of every run; those of its updates follow, then those of the clock."""
_logger = logging.getLogger(__name__)
_SECONDS_BETWEEN_LINES = 15.0


class RunMonitor:
    """Counts every cost, writes metrics, shows progress, saves and ends training.

    Args:
        watch: Counts the agent's episodes.
        evolution: Evaluates populations; None for a bare agent.
        budget: When to end.
        table: Gets one row per batch.
        save: Called with all steps so far to save a checkpoint.
        save_interval_s: Seconds between checkpoints.
        faults: Counts the worlds that diverged.
        updates: Count the updates that were skipped.
        signals: End training once one was received.
        logger: Also gets every number.
    """

    def __init__(
        self,
        watch: EpisodeWatch,
        evolution: Evolution | None,
        budget: BudgetConfig,
        table: MetricsTable,
        *,
        save: Callable[[int], object],
        save_interval_s: float = 30.0,
        faults: FaultFiles | None = None,
        updates: Sequence[Update] = (),
        signals: StopSignals | None = None,
        logger: Logger | None = None,
    ) -> None:
        self.phases = PhaseClock()
        self.watch, self.evolution = watch, evolution
        self.budget = budget
        self.table = table
        self.save = save
        self.save_interval_s = save_interval_s
        self.faults = faults
        self.updates = list(updates)
        self.signals = signals or StopSignals()
        self.logger = logger
        self.wall_s_before = 0.0
        self._started = time.monotonic()
        self._saved = self._started
        self._said = self._started
        self._evaluation: GeneticEvaluation | None = None
        self._batch_stats: dict[str, float] = {}
        self._loop: TrainingLoop | None = None
        self._bar: tqdm | None = None
        if evolution is not None:
            evolution.on_evaluation.append(self._note_evaluation)

    def register(self, loop: TrainingLoop) -> None:
        """Register with a loop, after every hook whose work is to be reported."""
        self._loop = loop
        self.phases.register(loop)
        loop.register_op("pre_steps_log", self._note_batch)
        loop.register_op("post_steps", self)

    def start(self) -> None:
        """Start the clock and the progress bar."""
        self._started = self._saved = self._said = time.monotonic()
        self.phases.start(self.total_steps)
        self._bar = tqdm(
            total=self.budget.agent_steps or self.budget.total_steps,
            initial=self._progress(),
            unit="step",
            unit_scale=True,
            file=sys.stderr,
            disable=None,
            dynamic_ncols=True,
        )

    def stop(self) -> None:
        """Close the bar."""
        if self._bar is not None:
            # The terminal may be gone.
            with contextlib.suppress(OSError):
                self._bar.close()

    @property
    def _counts(self) -> PopulationCounts:
        return PopulationCounts() if self.evolution is None else self.evolution.counts

    @property
    def agent_steps(self) -> int:
        """Environment steps of the agent."""
        return self._loop.collected_frames if self._loop else 0

    @property
    def total_steps(self) -> int:
        """Environment steps of agent and populations."""
        return self.agent_steps + self._counts.steps

    @property
    def wall_s(self) -> float:
        """Seconds of training, earlier starts of the run included."""
        return self.wall_s_before + time.monotonic() - self._started

    def counters(self) -> dict[str, float]:
        """Every cost so far."""
        counts = self._counts
        return {
            "agent_steps": self.agent_steps,
            "population_steps": counts.steps,
            "total_steps": self.total_steps,
            "wall_s": round(self.wall_s, 3),
            "evaluations": counts.evaluations,
            "switches": counts.switches,
        }

    def __call__(self) -> None:
        """Report, and save or end if it is time."""
        row = self._row()
        self.table.append(row)
        if self.logger is not None:
            self.logger.log_metrics(_curves(row), step=self.total_steps)
        self._show(row)
        spent = self.budget.is_spent(row)
        if spent or self.signals.received:
            assert self._loop is not None
            self._loop.request_stop()
        now = time.monotonic()
        if spent or self.signals.received or now - self._saved >= self.save_interval_s:
            self.save(self.total_steps)
            self._saved = time.monotonic()
        self.phases.begin_row(self.total_steps)

    def state_dict(self) -> dict[str, Any]:
        """The clock and diverged worlds; other counters belong to loop and hook."""
        return {"wall_s": self.wall_s, "diverged": self._num_diverged()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.wall_s_before = state_dict["wall_s"]
        if self.faults is not None:
            self.faults.num_diverged = state_dict["diverged"]
        self._started = time.monotonic()

    def _row(self) -> dict[str, Any]:
        counters = self.counters()
        row: dict[str, Any] = {
            **counters,
            "episodes": self.watch.episodes_completed,
            "success_rate": self.watch.window.running_rate,
            "return_mean": self._batch_stats.get("return_mean"),
            "without_fitness": self._counts.without_fitness,
            "diverged": self._num_diverged(),
            "skipped_updates": sum(update.num_skipped for update in self.updates),
        }
        if self._evaluation is not None:
            fitness = self._evaluation.scores[keys.FITNESS]
            row |= {
                "mut_p": self._evaluation.mut_p,
                "fitness_best": float(fitness[self._evaluation.winner]),
                "fitness_parent": _of_agent(self._evaluation, fitness),
                "fitness_mean": float(fitness.nanmean()),
                "winner": self._evaluation.winner,
                "switched": int(self._evaluation.switched),
            }
            self._evaluation = None
        for update in self.updates:
            row |= update.means.take()
        return row | self.phases.row(self.total_steps)

    def _num_diverged(self) -> int:
        return 0 if self.faults is None else self.faults.num_diverged

    def _note_batch(self, batch: TensorDictBase) -> None:
        done = batch["next", keys.DONE]
        returns = batch.get(("next", keys.EPISODE_RETURN), None)
        self._batch_stats = {}
        if returns is not None and bool(done.any()):
            self._batch_stats["return_mean"] = float(returns[done].mean())

    def _note_evaluation(self, evaluation: GeneticEvaluation) -> None:
        self._evaluation = evaluation

    def _progress(self) -> int:
        if self.budget.agent_steps is None and self.budget.total_steps is not None:
            return self.total_steps
        return self.agent_steps

    def _show(self, row: dict[str, Any]) -> None:
        rate = row["success_rate"]
        success = "  ?" if rate is None else f"{rate:.2f}"
        assert self._bar is not None
        if not self._bar.disable:
            self._bar.set_postfix_str(
                f"success {success}, population {row['population_steps']:,} steps, "
                f"switches {row['switches']}/{row['evaluations']}",
                refresh=False,
            )
            try:
                self._bar.update(self._progress() - self._bar.n)
            except OSError:
                # The terminal is gone; training goes on, or saves by SIGHUP.
                self._bar.disable = True
        elif time.monotonic() - self._said >= _SECONDS_BETWEEN_LINES:
            self._said = time.monotonic()
            _logger.info(
                "%d agent steps, %d population steps, %.0f s: success %s, switches %d/%d",
                row["agent_steps"],
                row["population_steps"],
                row["wall_s"],
                success,
                row["switches"],
                row["evaluations"],
            )


def columns_of(updates: Sequence[Update]) -> tuple[str, ...]:
    """Names of the columns of a run's metrics."""
    names = [name for update in updates for name in update.means.names]
    return (*COLUMNS, *names, *PHASES)


def _curves(row: dict[str, Any]) -> dict[str, Any]:
    """What TensorBoard shows of a row, in groups."""
    groups: dict[str, str] = dict.fromkeys(COLUMNS, "train")
    groups |= dict.fromkeys(("wall_s", *PHASES), "time")
    return {
        f"{groups.get(name, 'update')}/{name}": value
        for name, value in row.items()
        if value is not None and name != "total_steps"
    }


def _of_agent(evaluation: GeneticEvaluation, fitness: torch.Tensor) -> float | None:
    return None if evaluation.agent is None else float(fitness[evaluation.agent])
