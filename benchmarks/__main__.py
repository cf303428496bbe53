"""Every benchmark, one after another, and one table of what they found.

    python -m benchmarks [NAME ...]

Each runs in a process of its own and prints a table of its own while it does. The last
line is a JSON object with a key per benchmark. A benchmark that cannot run, as EvoTorch's
without the extra ``bench``, is named in the table.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

# Modules and their arguments, in the order in which they run.
BENCHMARKS: dict[str, list[list[str]]] = {
    "population_throughput": [[]],
    "evotorch_population": [[]],
    "rainbow_update": [[]],
    "ppo_epoch": [[]],
    "collection": [[]],
    "growth": [["--task", "indoor"], ["--task", "water"]],
    "startup": [[]],
    "training": [[]],
}


def run(name: str, arguments: list[str]) -> dict[str, Any] | None:
    """What the last line of a benchmark says; None if it failed."""
    print(f"\n== {name} {' '.join(arguments)}".rstrip(), flush=True)
    command = [sys.executable, "-m", f"benchmarks.{name}", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        last = ""
        for line in process.stdout:
            last = line
            if not line.startswith("{"):
                print(line, end="", flush=True)
    return json.loads(last) if process.returncode == 0 else None


def rows(name: str, found: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Labels and values of all ratios and times that a benchmark was made for."""
    wanted = ("ratio_to", "over", "efficiency", "help_s", "to_first_step", "median_wall_s")

    def walk(value: Any, path: tuple[str, ...]) -> Iterator[tuple[str, str]]:
        if isinstance(value, dict):
            for key, part in value.items():
                yield from walk(part, (*path, key))
        elif any(word in path[-1] for word in wanted) and not isinstance(value, bool):
            yield " ".join((name, *path)), "-" if value is None else f"{value:.3f}"

    return walk(found, ())


def main() -> None:
    """Run the benchmarks that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BENCHMARKS))
    options = parser.parse_args()
    unknown = set(options.names) - set(BENCHMARKS)
    if unknown:
        parser.error(f"no benchmark {sorted(unknown)}: there are {', '.join(BENCHMARKS)}")
    results: dict[str, Any] = {}
    table: list[tuple[str, str]] = []
    for name in options.names or BENCHMARKS:
        for arguments in BENCHMARKS[name]:
            found = run(name, arguments)
            if found is None:
                table.append((f"{name} {' '.join(arguments)}".strip(), "did not run"))
                continue
            results[name] = results.get(name, {}) | found
            table += rows(name, found)
    print("\n== all")
    for label, value in table:
        print(f"  {label:70s} {value:>12s}")
    print(json.dumps(results))


if __name__ == "__main__":
    main()
