"""Certify the presets: can they be solved, are they hard, can a difference show?

    python -m benchmarks.presets measure [PRESET ...]     controllers and untrained networks
    python -m benchmarks.presets commands [PRESET ...]    how to train the bare agents
    python -m benchmarks.presets runs FOLDER [PRESET ...] read their runs

What is found is written to results/presets/certified.csv, a row for each preset and
criterion, and printed; results/presets/certified.md has a line for each preset.
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
from benchmarks.presets.table import (
    SUMMARY,
    Row,
    certified,
    make_row,
    summary,
    update_table,
)
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


def read(presets: Sequence[Preset], folder: Path, commit: str) -> Iterator[Row]:
    """Rows of the bare agents whose runs are below a folder."""
    rows = [row for preset in presets for row in rows_of_runs(preset, folder, commit)]
    if not rows:
        raise ValueError(f"{folder} must hold runs of certify_<preset>: there are none")
    yield from rows


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
    if options.what == "measure":
        found = measured(presets, options.episodes, commit, options.threads)
    elif folder is None:
        fail("runs must be followed by the folder of the runs")
    else:
        found = read(presets, folder, commit)
    rows: list[Row] = []
    try:
        for row in found:
            # At once: there may be an hour between two rows.
            rows = update_table([row])
            SUMMARY.write_text(summary(rows))
            print(_line(row), flush=True)
    except (OSError, ValueError) as error:
        fail(error)
    for name, verdict in certified(rows).items():
        print(f"{name:18s} {verdict}")


if __name__ == "__main__":
    main()
