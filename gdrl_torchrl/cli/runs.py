"""``gdrl-runs <folder> [state=done] [<config key>=<value> ...]``: a table of runs."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gdrl_torchrl.cli.shared.arguments import CommandParser, fail, one_line
from gdrl_torchrl.files.run_table import (
    STATES,
    find_runs,
    format_table,
    run_row,
    select_runs,
    values_of,
)

_OPTIONS = [
    ("<folder>", "All runs below it are listed; damaged ones are named below the table."),
    (
        f"state={'|'.join(STATES)}",
        "Runs that ended, go on, can go on, or met an error.",
    ),
    ("algorithm=<name>, task=<name>", "As the columns of the table say."),
    ("<option>=<value>", "Any option of a run, such as task.sea=rough or seed=1."),
]
_PARSER = CommandParser(
    "gdrl-runs",
    "<folder> [<option>=<value> ...]",
    "A table of the runs below a folder, of those that have all the values given.",
    [("arguments", _OPTIONS)],
    [
        "gdrl-runs runs",
        "gdrl-runs runs state=done task=water evolution.num_children=10",
    ],
)


def list_runs(arguments: list[str]) -> str:
    """The table as text.

    Raises:
        ValueError: If there is no such folder, or an argument is not one.
    """
    return format_table(rows_of(arguments))


def rows_of(arguments: list[str]) -> list[dict[str, Any]]:
    """The rows of the table, see :func:`~gdrl_torchrl.files.run_table.run_row`.

    Raises:
        ValueError: If there is no such folder, or an argument is not one.
    """
    folders = [a for a in arguments if "=" not in a or Path(a).is_dir()]
    if len(folders) != 1:
        given = " ".join(arguments) or "nothing"
        raise ValueError(f"{given}: one folder must be given: see gdrl-runs --help")
    if not Path(folders[0]).is_dir():
        raise ValueError(f"{folders[0]} must be a folder with runs below it")
    wanted = dict(a.split("=", 1) for a in arguments if a not in folders)
    if wanted.get("state", STATES[0]) not in STATES:
        raise ValueError(f"state={wanted['state']} must be one of {', '.join(STATES)}")
    runs = find_runs(folders[0])
    selected = select_runs(runs, wanted)
    if not selected:
        _say_what_there_is(runs, wanted)
    return [run_row(run) for run in selected]


def _say_what_there_is(runs: Sequence[Path], wanted: Mapping[str, str]) -> None:
    """Name, where a table is empty, the values that would select something."""
    for name, text in wanted.items():
        values = values_of(runs, name)
        if values and text not in values:
            print(f"no run has {name}={text}, but {', '.join(values)}", file=sys.stderr)


def main() -> None:
    """Entry point of ``gdrl-runs``: after the table, an error per damaged run."""
    arguments = _PARSER.parse_args().arguments
    try:
        rows = rows_of(arguments)
    except ValueError as error:
        fail(error)
    print(format_table(rows))
    damages = [row["damage"] for row in rows if row["damage"] is not None]
    if damages:
        sys.exit("\n".join(f"error: {one_line(damage)}" for damage in damages))


if __name__ == "__main__":
    main()
