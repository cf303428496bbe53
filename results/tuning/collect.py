"""Write what a search tried, and what runs of its candidates gave, as tables.

    python results/tuning/collect.py <search.journal> <folder of runs> <prefix>

Writes ``<prefix>_trials.csv`` and ``<prefix>_runs.csv`` beside itself.
"""

import csv
import json
import sys
from pathlib import Path

HERE = Path(__file__).parent
SETTINGS = (
    ("algorithm", "learning_rate"),
    ("algorithm", "entropy_coeff"),
    ("algorithm", "gamma"),
    ("algorithm", "lmbda"),
    ("algorithm", "frames_per_batch"),
    ("network", "initial_std"),
)


def trials(journal: Path) -> list[dict[str, object]]:
    """A row a trial and budget: mean success over the seeds of the search."""
    rows, overrides = [], {}
    for line in journal.read_text().splitlines():
        entry = json.loads(line)
        number = entry.get("trial_id")
        if "overrides" in entry.get("user_attr", {}):
            overrides[number] = " ".join(entry["user_attr"]["overrides"])
        if "intermediate_value" in entry:
            rows.append(
                {
                    "trial": number,
                    "total_steps": entry["step"],
                    "success_rate": entry["intermediate_value"],
                    "overrides": overrides[number],
                }
            )
    return sorted(rows, key=lambda row: (row["trial"], row["total_steps"]))


def runs(folder: Path) -> list[dict[str, object]]:
    """A row a finished run below a folder."""
    rows = []
    for file in sorted(folder.rglob("evaluation.json")):
        told = json.loads(file.read_text())
        config = json.loads(file.with_name("config.json").read_text())
        rows.append(
            {
                "name": config["name"],
                "algorithm": told["algorithm"],
                "seed": told["seed"],
                **{name: config[group][name] for group, name in SETTINGS},
                **{n: told[n] for n in ("success_rate", "success_rate_sampled")},
                **{n: told[n] for n in ("agent_steps", "total_steps", "params_sha256")},
            }
        )
    return sorted(rows, key=lambda row: (row["name"], row["seed"]))


def write(path: Path, rows: list[dict[str, object]]) -> None:
    """Write rows under the names of the first one's cells."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    journal, folder, prefix = sys.argv[1:]
    write(HERE / f"{prefix}_trials.csv", trials(Path(journal)))
    write(HERE / f"{prefix}_runs.csv", runs(Path(folder)))
