"""Results of a study: small tables that are committed, and that nobody edits by hand."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gdrl_torchrl.files.fields import (
    COUNT,
    DIGEST,
    NUMBER,
    OBJECT,
    RATE,
    SECONDS,
    SOME,
    TEXT,
    Kind,
    read_object,
    read_text,
)
from gdrl_torchrl.files.safe_files import locked, own_folder, written_aside
from gdrl_torchrl.studies.protocol import Job, protocol_sha256

_STATE = Kind("done or failed", lambda x: x in ("done", "failed"))
_ANY_TEXT = Kind("a line of text", lambda x: isinstance(x, str) and "\n" not in x)
_JOB = {"protocol": TEXT, "task": TEXT, "method": TEXT, "seed": COUNT}
RUN_COLUMNS: dict[str, Kind] = {
    **_JOB,
    "state": _STATE,
    **dict.fromkeys(("area", "area_sampled", "success_rate", "success_rate_sampled"), RATE),
    **dict.fromkeys(("return_mean", "episode_steps", "episode_s", "speed_m_s"), NUMBER),
    **dict.fromkeys(("agent_steps", "population_steps", "total_steps"), COUNT),
    "agent_episodes": COUNT,
    "wall_s": SECONDS,
    **dict.fromkeys(("evaluations", "switches"), COUNT),
    **dict.fromkeys(("configuration", "code", "packages", "error"), _ANY_TEXT),
}
"""One row a run; areas are means over the policies of its curve. A run that failed has
succeeded nowhere, and its other cells are what was reached."""
CURVE_COLUMNS: dict[str, Kind] = {
    **_JOB,
    "point": SOME,
    **dict.fromkeys(("total_steps", "agent_steps", "agent_episodes"), COUNT),
    "wall_s": SECONDS,
    **dict.fromkeys(("success_rate", "success_rate_sampled"), RATE),
}
"""One row a policy that a run has kept."""
ELSEWHERE_COLUMNS: dict[str, Kind] = {
    **_JOB,
    "worlds": TEXT,
    **dict.fromkeys(("success_rate", "success_rate_sampled"), RATE),
    **dict.fromkeys(("collision_rate", "timeout_rate"), RATE),
}
"""One row for each kind of other worlds that a run's final policy was evaluated on."""
_DIGEST = "digest"
_WHOLE = (COUNT, SOME)
_NUMBERS = (*_WHOLE, RATE, NUMBER, SECONDS)


class StudyResults:
    """The folder of a study's results: ``protocol.json`` and tables.

    The tables are ``runs.csv``, ``curves.csv`` and, if there are other worlds,
    ``elsewhere.csv``.

    Every row ends with a digest of its cells: one that was changed by hand is noticed.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def begin(self, protocol: dict[str, Any]) -> None:
        """Write the protocol, or check that the results here are of the same one.

        Raises:
            ValueError: If they are of another one.
            OSError: If it cannot be written.
        """
        own_folder(self.folder)
        with self._turn():
            path = self.folder / "protocol.json"
            digest = protocol_sha256(protocol)
            if path.exists():
                before = self.protocol()[1]
                if before != digest:
                    raise ValueError(
                        f"{self.folder} has results of protocol {before[:12]}, and this is "
                        f"{digest[:12]}: a study with another protocol has another name"
                    )
                return
            content = {"sha256": digest, "protocol": protocol}
            with written_aside(path) as aside:
                aside.write_text(json.dumps(content, indent=2) + "\n")

    def protocol(self) -> tuple[dict[str, Any], str]:
        """The protocol and its digest.

        Raises:
            FileNotFoundError: If there is none.
            ValueError: If it is not one, or was changed.
        """
        path = self.folder / "protocol.json"
        content = read_object(path, {"sha256": DIGEST, "protocol": OBJECT})
        digest = protocol_sha256(content["protocol"])
        if digest != content["sha256"]:
            raise ValueError(f"{path} was changed: its digest is {digest}")
        return content["protocol"], digest

    def runs(self) -> list[dict[str, Any]]:
        """The rows of ``runs.csv``, in order; none if there is no such file.

        Raises:
            ValueError: If a row is damaged, or was changed by hand.
        """
        return self._read("runs.csv", RUN_COLUMNS)

    def curves(self) -> list[dict[str, Any]]:
        """The rows of ``curves.csv`` of runs in ``runs.csv``, in order.

        Raises:
            ValueError: If a row is damaged, or was changed by hand.
        """
        return self._of_runs("curves.csv", CURVE_COLUMNS)

    def elsewhere(self) -> list[dict[str, Any]]:
        """The rows of ``elsewhere.csv`` of runs in ``runs.csv``, in order.

        Raises:
            ValueError: If a row is damaged, or was changed by hand.
        """
        return self._of_runs("elsewhere.csv", ELSEWHERE_COLUMNS)

    def jobs(self) -> dict[Job, str]:
        """The runs that have ended, with their states."""
        return {job_of(row): row["state"] for row in self.runs()}

    def add(
        self,
        run: Mapping[str, Any],
        curve: Sequence[Mapping[str, Any]],
        elsewhere: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """Add the results of a run, unless they are there.

        Args:
            run: Its row, without digest.
            curve: The rows of its curve.
            elsewhere: Its rows for other worlds.

        Raises:
            ValueError: If a value is not what its column must be, or a table is damaged.
            OSError: If a table cannot be written; it is then as it was.
        """
        with self._turn():
            runs = self.runs()
            if job_of(run) in {job_of(row) for row in runs}:
                return
            self._write("curves.csv", CURVE_COLUMNS, [*self.curves(), *curve])
            if others := [*self.elsewhere(), *elsewhere]:
                self._write("elsewhere.csv", ELSEWHERE_COLUMNS, others)
            self._write("runs.csv", RUN_COLUMNS, [*runs, run])

    def _turn(self) -> Any:
        return locked(self.folder / ".lock", wait=True)

    def _of_runs(self, name: str, columns: Mapping[str, Kind]) -> list[dict[str, Any]]:
        runs = {job_of(row) for row in self.runs()}
        # A process may have been killed between two tables.
        return [row for row in self._read(name, columns) if job_of(row) in runs]

    def _read(self, name: str, columns: Mapping[str, Kind]) -> list[dict[str, Any]]:
        path = self.folder / name
        if not path.exists():
            return []
        found = csv.reader(io.StringIO(read_text(path)))
        names = [*columns, _DIGEST]
        header = next(found, [])
        if header != names:
            raise ValueError(f"{path}: its columns must be {', '.join(names)}")
        rows: dict[Any, dict[str, Any]] = {}
        for number, cells in enumerate(found, start=2):
            where = f"{path}, line {number}"
            if len(cells) != len(names) or cells[-1] != row_digest(cells[:-1]):
                raise ValueError(
                    f"{where} was changed or cut off, for its digest is not that of its "
                    "cells: take the file as it was committed"
                )
            row = _typed(cells, columns, where)
            key = _place(row)
            if key in rows:
                raise ValueError(f"{where}: a row of this run is there already")
            rows[key] = row
        return [rows[key] for key in sorted(rows)]

    def _write(
        self, name: str, columns: Mapping[str, Kind], rows: Iterable[Mapping[str, Any]]
    ) -> None:
        path = self.folder / name
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*columns, _DIGEST])
        for row in sorted(rows, key=_place):
            for column, kind in columns.items():
                kind.check(row[column], f"{path}: {column}")
            cells = [str(row[column]) for column in columns]
            writer.writerow([*cells, row_digest(cells)])
        with written_aside(path) as aside:
            aside.write_text(text.getvalue())


def job_of(row: Mapping[str, Any]) -> Job:
    """The run that a row is of."""
    return Job(row["task"], row["method"], row["seed"])


def _place(row: Mapping[str, Any]) -> tuple[Job, int, str]:
    """Where a row stands in its table, and what no other row in it has."""
    return job_of(row), row.get("point", 0), row.get("worlds", "")


def row_digest(cells: Iterable[str]) -> str:
    """Twelve hexadecimal digits of the cells of a row.

    Examples:
        >>> row_digest(["near", "ppo", "0"])
        '9b9d76f79db4'
    """
    return hashlib.sha256("\x1f".join(cells).encode()).hexdigest()[:12]


def _typed(cells: Sequence[str], columns: Mapping[str, Kind], where: str) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for (name, kind), cell in zip(columns.items(), cells, strict=False):
        value: Any = cell
        if kind in _NUMBERS:
            try:
                value = int(cell) if kind in _WHOLE else float(cell)
            except ValueError as error:
                raise ValueError(f"{where}: {name}={cell!r} is no number") from error
        kind.check(value, f"{where}: {name}")
        row[name] = value
    return row
