"""Run seeds of an arm, one after another, and append what each ended with to ``<arm>.csv``.

``python results/safe_mutation/ten_seeds.py new safe_mutation_indoor --seeds 0 1 2``, with
``--train`` for the ``gdrl-train`` of another commit. Seeds that are in the file are passed
over. Any further argument is an override of the run.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import subprocess
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
SETTINGS = [
    "budget.agent_steps=null",
    "budget.total_steps=300000",
    "logger.video_episodes=0",
    "logger.tensorboard=false",
    "simulation.num_threads=1",
]
RESULT = [
    *("success_rate", "success_rate_sampled", "collision_rate", "timeout_rate"),
    *("agent_steps", "population_steps", "total_steps", "wall_s", "params_sha256"),
]
METRICS = ["evaluations", "switches", "value_shift_median"]
COLUMNS = ["experiment", "seed", "code", "overrides", *RESULT, *METRICS]


def seeds_in(file: Path) -> set[int]:
    """Seeds that a file has rows of."""
    if not file.exists():
        return set()
    with file.open(newline="") as lines:
        return {int(row["seed"]) for row in csv.DictReader(lines)}


def of_metrics(file: Path) -> dict[str, object]:
    """How often a population was evaluated, changed the agent, and its values how far."""
    with file.open(newline="") as lines:
        rows = [row for row in csv.DictReader(lines) if row.get("switched")]
    shifts = [float(row["value_shift"]) for row in rows if row.get("value_shift")]
    return {
        "evaluations": len(rows),
        "switches": sum(float(row["switched"]) > 0 for row in rows),
        "value_shift_median": statistics.median(shifts) if shifts else "",
    }


def row_of(run: Path) -> dict[str, object]:
    """What a run that has ended gave."""
    record = json.loads((run / "evaluation.json").read_text())
    made_with = json.loads((run / "provenance.json").read_text())
    return {
        "seed": record["seed"],
        "code": made_with["git"] or made_with["code"],
        **{name: record.get(name, "") for name in RESULT},
        **of_metrics(run / "metrics.csv"),
    }


def append(file: Path, row: dict[str, object]) -> None:
    """Add a row to a file, with a header if it is new."""
    is_new = not file.exists()
    with file.open("a", newline="") as lines:
        writer = csv.DictWriter(lines, COLUMNS, lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(row)


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("arm", help="name of the file without .csv")
    parser.add_argument("experiment")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)))
    parser.add_argument("--train", default="gdrl-train", help="command that trains")
    options, overrides = parser.parse_known_args()
    file = HERE / f"{options.arm}.csv"
    for seed in options.seeds:
        if seed in seeds_in(file):
            continue
        with tempfile.TemporaryDirectory() as runs:
            command = [options.train, f"experiment={options.experiment}", f"seed={seed}"]
            subprocess.run(
                [*command, *SETTINGS, *overrides, f"runs_dir={runs}"], check=True
            )
            (result,) = Path(runs).rglob("evaluation.json")
            given = {"experiment": options.experiment, "overrides": " ".join(overrides)}
            append(file, given | row_of(result.parent))


if __name__ == "__main__":
    main()
