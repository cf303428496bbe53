"""Certify the presets: can they be solved, are they hard, can a difference show?

    python -m benchmarks.presets measure [PRESET ...]     controllers and untrained networks
    python -m benchmarks.presets commands [PRESET ...]    how to train the bare agents
    python -m benchmarks.presets runs FOLDER [PRESET ...] read their runs

What is found is written to results/presets/certified.csv, a row for each preset and
criterion, and printed.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")

from benchmarks.presets.bare_agents import rows_of_runs
from benchmarks.presets.known import PRESETS, Preset
from benchmarks.presets.table import Row, certified, make_row, update_table
from gdrl_torchrl.cli.shared.arguments import fail


def measured(
    presets: Sequence[Preset], episodes: int, commit: str, num_threads: int
) -> Iterator[Row]:
    """Rows of the controllers, then of the untrained networks, as they are found."""
    # Both take seconds to import, and commands need neither.
    from benchmarks.presets.measure import scripted, untrained

    known: dict[str, Any] = {"episodes": episodes, "total_steps": None, "commit": commit}
    for preset in presets:
        rate = scripted(preset.overrides, episodes, num_threads=num_threads)
        settings = " ".join(preset.overrides)
        yield make_row(
            preset.name, "scripted", [rate], seeds=[0], settings=settings, **known
        )
    seeds = range(10)
    for preset, mode in itertools.product(presets, ("greedy", "sampled")):
        rates = untrained(
            preset.overrides, mode, episodes, seeds=seeds, num_threads=num_threads
        )
        settings = " ".join(preset.overrides)
        criterion = f"untrained_{mode}"
        yield make_row(
            preset.name, criterion, list(rates), seeds=seeds, settings=settings, **known
        )


def show(rows: Sequence[Row]) -> None:
    """Print rows, and what follows for each preset."""
    for row in rows:
        print(_line(row))
    for preset, verdict in certified(rows).items():
        print(f"{preset:18s} {verdict}")


def _line(row: Row) -> str:
    figure = f"{row.figure} [{row.low}, {row.high}]"
    return f"{row.preset:18s} {row.criterion:18s} {figure} {row.verdict}"


def main() -> None:
    """Do what is asked for with the presets that are named, or with all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("measure", "commands", "runs"))
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--episodes", type=int, default=200, help="worlds (measure)")
    parser.add_argument("--threads", type=int, default=0, help="of the simulation")
    parser.add_argument("--seeds", type=int, default=10, help="seeds (commands)")
    options = parser.parse_intermixed_args()
    names = options.names
    folder = Path(names.pop(0)) if options.what == "runs" and names else None
    if unknown := set(names) - set(PRESETS):
        fail(f"preset={sorted(unknown)[0]} must be one of {', '.join(PRESETS)}")
    presets = [PRESETS[name] for name in names or PRESETS]
    if options.what == "commands":
        for preset in presets:
            print(preset.command(options.seeds))
        return
    from gdrl_torchrl.runs.place import provenance

    commit = provenance()["git"] or "unknown"
    if options.what == "runs":
        if folder is None:
            fail("runs must be followed by the folder of the runs")
        try:
            rows = [
                row for preset in presets for row in rows_of_runs(preset, folder, commit)
            ]
        except (OSError, ValueError) as error:
            fail(error)
        if not rows:
            fail(f"{folder} must be a folder with runs certify_<preset>: there are none")
        show(update_table(rows))
        return
    everything: list[Row] = []
    for row in measured(presets, options.episodes, commit, options.threads):
        everything = update_table([row])
        print(_line(row), flush=True)
    show(everything)


if __name__ == "__main__":
    main()
