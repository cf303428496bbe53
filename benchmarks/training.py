"""Seconds of training until the task is mastered.

    python -m benchmarks.training [--budget-s 600] [--baseline-python PATH]

Whole runs of ``gdrl-train`` in processes of their own: GPPO on the water until 0.9 of the
last hundred training episodes reach the goal, GRainbow indoors until 0.75 do, for a few
seeds each. A run is stopped at its first row of ``metrics.csv`` with such a window, and
counts as censored if it has trained for the budget before. Only a full window counts.
The seconds are the run's own: training, populations and checkpoints, not start-up.

``--baseline-python`` is the interpreter of an environment with another version of the
package: every run is then made with both, one after the other. Two versions need not
learn alike from the same seed, so steps per second are compared too, which luck has no
part in. The last line is a JSON object.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.common import finish, read_rows

BARS = {"water": ("gppo_water", 0.9), "indoor": ("grainbow_indoor", 0.75)}
"""Experiment and success rate of each task."""
WINDOW = 100
"""Episodes that the rate is over."""
OVERRIDES = (
    f"evolution.window_episodes={WINDOW}",
    "budget.agent_steps=1_000_000_000",
    "budget.total_steps=null",
    "logger.tensorboard=false",
    "logger.video_episodes=0",
)
_SECONDS_BETWEEN_LOOKS = 2.0
_SECONDS_TO_STOP = 60.0


@dataclasses.dataclass
class Training:
    """What one run came to."""

    reached: bool
    """Whether it reached the bar within the budget."""
    wall_s: float
    agent_steps: int
    total_steps: int

    @property
    def steps_per_s(self) -> float:
        """Steps of agent and populations by second of training."""
        return self.total_steps / self.wall_s

    def __str__(self) -> str:
        return f"{self.wall_s:.0f} s" if self.reached else f"> {int(self.wall_s)} s"


def is_full(row: dict[str, str]) -> bool:
    """Whether a row's success rate is over a whole window.

    The rate of a window that is still filling is reported too. Enough episodes may have
    ended and yet wait, out of the window, for earlier ones; then the rate is a fraction
    of fewer episodes, which is rarely a whole number of hundredths.
    """
    if int(row["episodes"]) < WINDOW or not row["success_rate"]:
        return False
    count = float(row["success_rate"]) * WINDOW
    return abs(count - round(count)) < 1e-6


def last_row(
    folder: Path, bar: float, budget_s: float
) -> tuple[dict[str, str], bool] | None:
    """The row that ends a run and whether it reaches the bar; None before it is there."""
    for row in read_rows(folder):
        if is_full(row) and float(row["success_rate"]) >= bar:
            return row, float(row["wall_s"]) <= budget_s
        if float(row["wall_s"]) > budget_s:
            return row, False
    return None


def train(python: str, task: str, seed: int, budget_s: float) -> Training:
    """Train until the bar or the budget.

    Raises:
        RuntimeError: If the run ends by itself.
    """
    experiment, bar = BARS[task]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        overrides = [f"experiment={experiment}", f"seed={seed}", "runs_dir=runs"]
        command = [python, "-m", "gdrl_torchrl.cli.train", *overrides, *OVERRIDES]
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        # In a folder of its own: beside its interpreter's package there is no other.
        with open(folder / "log", "w") as log:
            process = subprocess.Popen(
                command, cwd=folder, env=environment, stdout=log, stderr=log
            )
        try:
            found = None
            while found is None:
                if process.poll() is not None:
                    text = (folder / "log").read_text()[-2000:]
                    raise RuntimeError(f"the run ended by itself:\n{text}")
                time.sleep(_SECONDS_BETWEEN_LOOKS)
                found = last_row(folder, bar, budget_s)
        finally:
            stop(process)
    row, reached = found
    steps = int(row["agent_steps"]), int(row["total_steps"])
    return Training(reached, float(row["wall_s"]), *steps)


def stop(process: subprocess.Popen) -> None:
    """End a run by a signal, or by force if it does not listen."""
    if process.poll() is not None:
        return
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(_SECONDS_TO_STOP)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def summary(runs: list[Training], budget_s: float) -> dict[str, Any]:
    """Median and single runs; a censored median is None."""
    times = [run.wall_s if run.reached else float("inf") for run in runs]
    median = statistics.median_high(times)
    return {
        "median_wall_s": round(median, 1) if median <= budget_s else None,
        "median_steps_per_s": round(statistics.median(r.steps_per_s for r in runs), 1),
        "runs": [dataclasses.asdict(run) for run in runs],
    }


def compare(own: list[Training], its: list[Training]) -> dict[str, Any]:
    """How many times as fast as a baseline, over the runs that both brought to the bar."""
    pairs = list(zip(own, its, strict=True))
    both = [b.wall_s / a.wall_s for a, b in pairs if a.reached and b.reached]
    speed = [a.steps_per_s / b.steps_per_s for a, b in pairs]
    return {
        "baseline_wall_s_over_own": round(statistics.median(both), 3) if both else None,
        "pairs_that_reached": len(both),
        "own_steps_per_s_over_baseline": round(statistics.median(speed), 3),
    }


def main() -> None:
    """Train on every task with every seed and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", choices=list(BARS), default=list(BARS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--budget-s", type=float, default=600.0)
    parser.add_argument("--baseline-python")
    options = parser.parse_args()
    pythons = {"own": sys.executable, "baseline": options.baseline_python}
    results: dict[str, Any] = {"budget_s": options.budget_s}
    for task in options.tasks:
        experiment, bar = BARS[task]
        print(f"{task}: {experiment} until {bar} of the last {WINDOW} episodes")
        runs: dict[str, list[Training]] = {w: [] for w, python in pythons.items() if python}
        for seed in options.seeds:
            for whose, made in runs.items():
                run = train(pythons[whose], task, seed, options.budget_s)
                made.append(run)
                print(
                    f"  seed {seed} {whose:9s} {run!s:>9s} {run.total_steps:12,} steps "
                    f"{run.steps_per_s:8,.0f} steps/s",
                    flush=True,
                )
        results[task] = {w: summary(made, options.budget_s) for w, made in runs.items()}
        results[task]["success_rate"] = bar
        if "baseline" in runs:
            results[task] |= compare(runs["own"], runs["baseline"])
    finish(results)


if __name__ == "__main__":
    main()
