"""``gdrl-runs <folder> [state=done] [<config key>=<value> ...]``: a table of runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from gdrl_torchrl.analysis.run_table import (
    STATES,
    find_runs,
    format_table,
    run_row,
    select_runs,
)

_USAGE = (
    f"usage: gdrl-runs <folder> [state={'|'.join(STATES)}] [<config key>=<value> ...]\n"
    "example: gdrl-runs runs state=done task.name=water evolution.num_children=10"
)


def list_runs(arguments: list[str]) -> str:
    """The table as text.

    Raises:
        ValueError: If there is no such folder, or an argument is not one.
    """
    return format_table(rows_of(arguments))


def rows_of(arguments: list[str]) -> list[dict[str, Any]]:
    """The rows of the table, see :func:`~gdrl_torchrl.analysis.run_table.run_row`.

    Raises:
        ValueError: If there is no such folder, or an argument is not one.
    """
    if not arguments or "=" in arguments[0] or arguments[0].startswith("-"):
        raise ValueError(_USAGE)
    folder, *filters = arguments
    if not Path(folder).is_dir():
        raise ValueError(f"{folder} is not a folder\n{_USAGE}")
    wanted = {}
    for argument in filters:
        name, equals, value = argument.partition("=")
        if not equals:
            raise ValueError(f"unknown argument {argument!r}\n{_USAGE}")
        wanted[name] = value
    if wanted.get("state", STATES[0]) not in STATES:
        raise ValueError(f"state={wanted['state']!r} must be one of {STATES}")
    return [run_row(run) for run in select_runs(find_runs(folder), wanted)]


def main() -> None:
    """Entry point of ``gdrl-runs``: after the table, an error per damaged run."""
    try:
        rows = rows_of(sys.argv[1:])
        print(format_table(rows))
    except ValueError as error:
        sys.exit(f"error: {error}")
    damages = [f"error: {row['damage']}" for row in rows if row["damage"] is not None]
    if damages:
        sys.exit("\n".join(damages))


if __name__ == "__main__":
    main()
