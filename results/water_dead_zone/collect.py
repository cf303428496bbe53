"""Write the runs below a folder: ``python collect.py <folder> > runs.csv``."""

import csv
import json
import sys
from pathlib import Path

RESULT = (
    *("success_rate", "success_rate_sampled", "agent_steps", "total_steps"),
    "params_sha256",
)


def rows(folder: Path) -> list[dict[str, object]]:
    """What each finished run ended with."""
    found = []
    for file in sorted(folder.rglob("evaluation.json")):
        result = json.loads(file.read_text())
        config = json.loads(file.with_name("config.json").read_text())
        found.append(
            {
                "arm": config["name"],
                "seed": result["seed"],
                "dead_zone_compensated": config["task"]["dead_zone_compensated"],
                **{name: result[name] for name in RESULT},
            }
        )
    return sorted(found, key=lambda row: (row["arm"], row["seed"]))


if __name__ == "__main__":
    table = rows(Path(sys.argv[1]))
    writer = csv.DictWriter(sys.stdout, list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
