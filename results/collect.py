"""Write the finished runs below a folder as a table, with the options that tell them apart.

    python results/collect.py <folder> [<option> ...] > runs.csv

An option is written as on the command line: ``algorithm.learning_rate``.
"""

import csv
import functools
import json
import sys
from pathlib import Path

RESULT = (
    *("success_rate", "success_rate_sampled", "agent_steps", "total_steps"),
    "params_sha256",
)


def rows(folder: Path, options: list[str]) -> list[dict[str, object]]:
    """What each finished run was made with, and what it ended with."""
    found = []
    for file in sorted(folder.rglob("evaluation.json")):
        result = json.loads(file.read_text())
        config = json.loads(file.with_name("config.json").read_text())
        found.append(
            {
                "arm": config["name"],
                "seed": result["seed"],
                **{
                    option: functools.reduce(dict.__getitem__, option.split("."), config)
                    for option in options
                },
                **{name: result[name] for name in RESULT},
            }
        )
    return sorted(found, key=lambda row: (row["arm"], row["seed"]))


if __name__ == "__main__":
    table = rows(Path(sys.argv[1]), sys.argv[2:])
    writer = csv.DictWriter(sys.stdout, list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
