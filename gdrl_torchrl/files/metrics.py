"""Reading ``metrics.csv``: numbers between commas, a line per iteration of training."""

from __future__ import annotations

import contextlib
import csv
import itertools
import logging
import os
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.fields import (
    COUNT,
    NUMBER,
    RATE,
    SECONDS,
    Kind,
    read_text,
)
from gdrl_torchrl.files.safe_files import open_own, written_aside

_logger = logging.getLogger(__name__)

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


class MetricsTable:
    """``metrics.csv``: one row per training iteration, blank where nothing is known.

    Args:
        path: The file; rows that are there stay.
        columns: Names of the columns.
    """

    def __init__(self, path: Path, columns: tuple[str, ...]) -> None:
        self.path = path
        self.columns = columns
        with contextlib.suppress(FileExistsError):
            self._write([columns], os.O_CREAT | os.O_EXCL)

    def append(self, row: Mapping[str, float | int | None]) -> None:
        """Add a row.

        Raises:
            ValueError: If a name is not a column.
        """
        unknown = row.keys() - set(self.columns)
        if unknown:
            raise ValueError(f"metrics {sorted(unknown)} have no column")
        cells = [row.get(name) for name in self.columns]
        self._write([["" if cell is None else cell for cell in cells]], os.O_APPEND)

    def cut_after(self, total_steps: int) -> None:
        """Drop the rows after a step: what a resumed run will write again.

        Rows before it that are missing are named in a warning.

        Raises:
            RunDirectoryError: If the table is damaged.
            OSError: If the system cannot read or write it.
        """
        try:
            # A row that a kill cut short lacks the end of its line.
            names, lines, rest = split_lines(self.path)
            if not names and not ",".join(self.columns).startswith(rest.rstrip("\r")):
                raise ValueError("its first line is not that of a table")
            if unknown := sorted(set(names) - set(self.columns)):
                raise ValueError(f"columns {unknown} are unknown")
            if names and "total_steps" not in names:
                raise ValueError("there is no column total_steps")
            rows = read_rows(names, lines, self.path)
        except OSError:
            # A ValueError too, but no damage: it may well be whole.
            raise
        except ValueError as error:
            raise RunDirectoryError(
                f"{self.path} is damaged: {error}: move it away to begin a new table"
            ) from error
        column = names.index("total_steps") if names else 0
        steps = [row[column] or 0 for row in rows]
        kept = [
            dict(zip(names, line.split(","), strict=True))
            for line, step in zip(lines, steps, strict=True)
            if step <= total_steps
        ]
        last = max((step for step in steps if step <= total_steps), default=0)
        if last < total_steps:
            _logger.warning(
                "%s has no rows from step %d to %d", self.path, last, total_steps
            )
        with written_aside(self.path) as aside, open(aside, "w", newline="") as file:
            writer = csv.DictWriter(file, self.columns)
            writer.writeheader()
            writer.writerows(kept)

    def _write(self, rows: Iterable[Sequence[object]], flags: int) -> None:
        descriptor = open_own(self.path, os.O_WRONLY | flags)
        with open(descriptor, "a", newline="") as file:
            csv.writer(file).writerows(rows)


METRICS_FILE = "metrics.csv"


def read_metrics(run_dir: str | Path) -> dict[str, np.ndarray]:
    """Read the table of training, one row per iteration.

    Of a last row that a kill cut short, the cell where it was cut is blank.

    Args:
        run_dir: Directory of the run.

    Returns:
        Columns by name, float64 ``[R]``; NaN where a cell is blank.

    Raises:
        FileNotFoundError: If there is no ``metrics.csv``.
        ValueError: If a row has more or fewer cells than the header, or a cell is not
            what its column holds.
    """
    path = Path(run_dir) / METRICS_FILE
    names, lines, rest = split_lines(path)
    if not names:
        raise ValueError(f"{path} has no line with the names of its columns")
    rows = read_rows(names, lines, path)
    if "," in rest:
        rows.append(read_row(names, rest, len(lines) + 2, path, is_cut=True))
    # None becomes NaN.
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
    return {name: table[:, column].copy() for column, name in enumerate(names)}
