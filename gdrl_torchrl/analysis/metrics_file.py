"""Reading ``metrics.csv``: numbers between commas, a line per iteration of training."""

from __future__ import annotations

import itertools
import reprlib
from collections.abc import Mapping
from pathlib import Path

from gdrl_torchrl.analysis.fields import COUNT, NUMBER, RATE, SECONDS, Kind, read_text

KINDS: Mapping[str, Kind] = {
    "agent_steps": COUNT,
    "population_steps": COUNT,
    "total_steps": COUNT,
    "wall_s": SECONDS,
    "episodes": COUNT,
    "success_rate": RATE,
    "evaluations": COUNT,
    "switches": COUNT,
    "without_fitness": COUNT,
    "mut_p": RATE,
    "switched": RATE,
}
"""What columns hold; others hold any numbers."""
COSTS = ("agent_steps", "total_steps", "wall_s")
"""Columns that are never blank."""


def split_lines(path: Path) -> tuple[list[str], list[str], str]:
    """Names of the columns, lines below them, and what a kill left of one more line.

    Without a whole first line there are no names.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not text, or its first line is not of different names.
    """
    *whole, rest = read_text(path).split("\n")
    header, *lines = (line.removesuffix("\r") for line in whole or [rest])
    names = header.split(",") if whole else []
    if len(set(names)) < len(names) or not all(names) or not header.isprintable():
        raise ValueError(f"{path}: {reprlib.repr(header)} must be names of columns")
    return names, lines, rest


def read_row(
    names: list[str], line: str, number: int, path: Path, *, is_cut: bool = False
) -> list[float | None]:
    """The numbers in a line, None where a cell is blank.

    Args:
        names: Names of the columns.
        line: The line.
        number: The line's, from 1, for errors.
        path: The file, for errors.
        is_cut: Whether a kill has cut the line: its last cell may be part of a number.

    Raises:
        ValueError: If there are not as many cells as names, or a cell is not what its
            column holds.
    """
    where = f"in line {number} of {path}"
    cells = line.split(",")
    if len(cells) > len(names) or (len(cells) < len(names) and not is_cut):
        raise ValueError(f"{len(cells)} cells {where}, its header has {len(names)}")
    if is_cut:
        whole = len(cells) - 1
        cells = cells[:whole] + [""] * (len(names) - whole)
    row = [
        _number(cell, KINDS.get(name, NUMBER), f"{name} {where}")
        for name, cell in zip(names, cells, strict=True)
    ]
    for name, value in zip(names, row, strict=True):
        if value is None and name in COSTS and not is_cut:
            raise ValueError(f"{name} {where} is blank")
    return row


def read_rows(names: list[str], lines: list[str], path: Path) -> list[list[float | None]]:
    """The numbers in the lines of :func:`split_lines`.

    Raises:
        ValueError: As :func:`read_row`; or if the steps become fewer.
    """
    rows = [read_row(names, line, n, path) for n, line in enumerate(lines, start=2)]
    if "total_steps" in names:
        column = names.index("total_steps")
        steps = [row[column] or 0 for row in rows]
        for number, (before, after) in enumerate(itertools.pairwise(steps), start=3):
            if after < before:
                raise ValueError(
                    f"total_steps in line {number} of {path}: {after} must not be "
                    f"below {before} of the line before"
                )
    return rows


def _number(text: str, kind: Kind, what: str) -> float | None:
    if not text.strip():
        return None
    try:
        value = int(text) if kind is COUNT and text.isdecimal() else float(text)
    except ValueError as error:
        raise ValueError(f"{what}: {reprlib.repr(text)} is not a number") from error
    kind.check(value, what)
    return value
