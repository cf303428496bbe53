"""What all benchmarks share: taking turns, ratios of turns, a table and a last line."""

from __future__ import annotations

import csv
import io
import json
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gdrl_tasks.processors import allowed_processors
from gdrl_torchrl.files.run_table import find_runs


def measure(*runs: Callable[[], int], repeats: int) -> list[list[float]]:
    """Steps per second of repeats of each run, which returns its steps.

    The runs take turns, so that a machine whose speed changes is as fast for all. Each
    runs once before, unmeasured.
    """
    for run in runs:
        run()
    rates: list[list[float]] = [[] for _ in runs]
    for _ in range(repeats):
        for run, found in zip(runs, rates, strict=True):
            start = time.perf_counter()
            steps = run()
            found.append(steps / (time.perf_counter() - start))
    return rates


def ratio(own: Sequence[float], its: Sequence[float]) -> float:
    """Median over turns of what one gave, by what the other gave."""
    turns = zip(own, its, strict=True)
    return round(statistics.median(one / other for one, other in turns), 4)


def show(label: str, value: float, digits: int = 0) -> None:
    """Print a row of a table."""
    print(f"  {label:44s} {value:12,.{digits}f}", flush=True)


def read_rows(folder: Path) -> list[dict[str, str]]:
    """The rows of the only run below a folder that are written to their ends."""
    for run in find_runs(folder):
        if (run / "metrics.csv").exists():
            text, end, _ = (run / "metrics.csv").read_text().rpartition("\n")
            return list(csv.DictReader(io.StringIO(text + end)))
    return []


def finish(results: dict[str, Any]) -> None:
    """Print the last line: results and the machine they were found on."""
    machine = {
        "processors": allowed_processors(),
        "machine": platform.machine(),
        "python": platform.python_version(),
    }
    print(json.dumps(results | {"machine": machine}))
