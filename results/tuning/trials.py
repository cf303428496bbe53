"""Write what a search tried: ``python trials.py <search.journal> > trials.csv``."""

import csv
import json
import sys
from pathlib import Path


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


if __name__ == "__main__":
    table = trials(Path(sys.argv[1]))
    writer = csv.DictWriter(sys.stdout, list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
