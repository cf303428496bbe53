"""Write the finished runs below a folder as a table, with the options that tell them apart.

    python results/collect.py <folder> [<option> ...] > runs.csv
    python results/collect.py <folder> --curves [<option> ...] > curves.csv

An option is written as on the command line: ``algorithm.learning_rate``. With ``--curves``
there is a row for each policy that a run has kept (``evaluation.num_policies``).
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
POINT = ("total_steps", "success_rate", "success_rate_sampled")


def rows(folder: Path, options: list[str], *, curves: bool) -> list[dict[str, object]]:
    """What each finished run was made with, and what it reached."""
    found = []
    for file in sorted(folder.rglob("evaluation.json")):
        result = json.loads(file.read_text())
        config = json.loads(file.with_name("config.json").read_text())
        made_with = {
            "arm": config["name"],
            "seed": result["seed"],
            **{
                option: functools.reduce(dict.__getitem__, option.split("."), config)
                for option in options
            },
        }
        reached, names = [result], RESULT
        if curves:
            kept = file.with_name("curve.json")
            reached = json.loads(kept.read_text())["points"] if kept.exists() else []
            names = POINT
        found += [made_with | {name: one[name] for name in names} for one in reached]
    return sorted(found, key=lambda row: (row["arm"], row["seed"], row["total_steps"]))


if __name__ == "__main__":
    given = [argument for argument in sys.argv[1:] if argument != "--curves"]
    table = rows(Path(given[0]), given[1:], curves="--curves" in sys.argv)
    if not table:
        sys.exit(f"below {given[0]} there is no finished run to collect")
    writer = csv.DictWriter(sys.stdout, list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
