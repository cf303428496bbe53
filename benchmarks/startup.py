"""Seconds until the command answers, and until a resumed run has made a training step.

    python -m benchmarks.startup

``gdrl-train --help`` from start to end of the process. Then each agent's experiment is
trained for a few iterations, stopped by a signal, which saves it, and started again: from
the start of that process until ``metrics.csv`` has a row more, so that imports, the
checkpoint and one whole iteration (collection and updates) are inside; the iteration's
own seconds, from the run's clock, are given beside it. Replay buffers are nearly empty
then; ``--rows`` fills them. Last, what is slow to import, by ``-X importtime``:
cumulative milliseconds, which hold those of what is imported in turn. Each is measured
once before, unmeasured. The last line is a JSON object.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.common import finish, read_rows, show

COMMAND = [sys.executable, "-m", "gdrl_torchrl.cli.train"]
HELP_BAR_S = 3.0
RESUME_BAR_S = 8.0
EXPERIMENTS = {"grainbow_indoor": 16, "gppo_water": 2}
"""Rows to make before the signal: Rainbow's first updates come after 2,000 steps."""
MODULES = ("gdrl_torchrl.cli.train", "gdrl_torchrl.runs.run")
"""What answers ``--help``, and what a run imports as well."""
_MOST_SECONDS = 120.0


def help_s() -> float:
    """Seconds of the console script's ``--help``."""
    script = Path(sys.executable).with_name("gdrl-train")
    command = [str(script)] if script.exists() else COMMAND
    start = time.perf_counter()
    subprocess.run([*command, "--help"], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def clock_of_rows(folder: Path) -> list[float]:
    """Training seconds at the whole rows of the only run below a folder."""
    return [float(row["wall_s"]) for row in read_rows(folder)]


def run_until(folder: Path, experiment: str, rows: int) -> float:
    """Start or go on with a run until it has rows; seconds since the process's start.

    Raises:
        RuntimeError: If the run ends before, or takes too long.
    """
    overrides = [f"experiment={experiment}", f"runs_dir={folder / 'runs'}"]
    with open(folder / "log", "w") as log:
        start = time.perf_counter()
        process = subprocess.Popen([*COMMAND, *overrides], stdout=log, stderr=log)
    try:
        while len(clock_of_rows(folder)) < rows:
            if process.poll() is not None or time.perf_counter() - start > _MOST_SECONDS:
                text = (folder / "log").read_text()[-2000:]
                raise RuntimeError(f"no {rows} rows from {experiment}:\n{text}")
            time.sleep(0.01)
        seconds = time.perf_counter() - start
        process.send_signal(signal.SIGTERM)
        process.wait(_MOST_SECONDS)
    finally:
        process.kill()
        process.wait()
    return seconds


def resume_s(experiment: str, rows: int, repeats: int) -> dict[str, Any]:
    """Seconds of starting a run, and of going on with it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        first = run_until(folder, experiment, rows)
        seconds, iterations = [], []
        for _ in range(1 + repeats):
            before = len(clock_of_rows(folder))
            seconds.append(run_until(folder, experiment, before + 1))
            clock = clock_of_rows(folder)
            iterations.append(clock[before] - clock[before - 1])
    found = statistics.median(seconds[1:])
    return {
        "resumed_to_first_step_s": round(found, 3),
        "of_which_the_iteration_s": round(statistics.median(iterations[1:]), 3),
        "reaches_bar": found <= RESUME_BAR_S,
        f"new_run_to_row_{rows}_s": round(first, 3),
    }


def slow_imports(module: str, count: int = 10) -> dict[str, float]:
    """Cumulative milliseconds of the imports that take the longest."""
    command = [sys.executable, "-X", "importtime", "-c", f"import {module}"]
    done = subprocess.run(command, check=True, stderr=subprocess.PIPE, text=True)
    found: dict[str, float] = {}
    for line in done.stderr.splitlines():
        _, bar, rest = line.removeprefix("import time:").partition("|")
        cumulative, _, name = rest.partition("|")
        if bar and cumulative.strip().isdigit():
            found[name.strip()] = int(cumulative) / 1000
    slowest = sorted(found.items(), key=lambda item: -item[1])[:count]
    return {name: round(milliseconds, 1) for name, milliseconds in slowest}


def main() -> None:
    """Measure and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--resumes", type=int, default=3)
    parser.add_argument("--rows", type=int, help="iterations before a run is resumed")
    options = parser.parse_args()
    os.environ.setdefault("MUJOCO_GL", "disable")
    print("seconds")
    help_s()
    found = statistics.median(help_s() for _ in range(options.repeats))
    show("gdrl-train --help", found, digits=2)
    results: dict[str, Any] = {
        "help_s": round(found, 3),
        "help_bar_s": HELP_BAR_S,
        "help_reaches_bar": found <= HELP_BAR_S,
        "resume_bar_s": RESUME_BAR_S,
    }
    for experiment, rows in EXPERIMENTS.items():
        resumed = resume_s(experiment, options.rows or rows, options.resumes)
        show(f"{experiment}, resumed", resumed["resumed_to_first_step_s"], digits=2)
        show("  of which the iteration", resumed["of_which_the_iteration_s"], digits=2)
        results[experiment] = resumed
    results["slowest_imports_ms"] = {}
    for module in MODULES:
        print(f"imports of {module}, milliseconds")
        slow_imports(module)
        slowest = slow_imports(module)
        for name, milliseconds in slowest.items():
            show(name, milliseconds)
        results["slowest_imports_ms"][module] = slowest
    finish(results)


if __name__ == "__main__":
    main()
