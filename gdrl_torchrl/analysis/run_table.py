"""Every run below a folder: what it is, how far it came, and what it cost."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gdrl_torchrl.analysis.run_files import EVALUATION_FILE

STATES = ("done", "running", "stopped", "failed")
COLUMNS = (
    "state",
    "name",
    "task",
    "algorithm",
    "seed",
    "success_rate",
    "agent_steps",
    "population_steps",
    "total_steps",
    "wall_s",
    "path",
)
_MISSING = object()


def find_runs(folder: str | Path) -> list[Path]:
    """Run directories below a folder, in the order of their names.

    What is inside a run is left alone: checkpoints of one that is training come and go.
    """
    runs = []
    for path, folders, files in os.walk(folder):
        if "config.json" in files:
            runs.append(Path(path))
            folders.clear()
    return sorted(runs)


def state_of(run: Path) -> str:
    """``done``, ``running``, ``failed`` (the last start ended in an error) or
    ``stopped`` (it was interrupted, and the same command goes on with it).
    """  # noqa: D205
    if _is_locked(run / ".lock"):
        return "running"
    if (run / "DONE").exists():
        return "done"
    return "failed" if (run / "FAILED").exists() else "stopped"


def run_row(run: Path) -> dict[str, Any]:
    """A run as a row of the table; None where nothing is known yet."""
    config = json.loads((run / "config.json").read_text())
    # runs/<name>/<task>/<algorithm>/<key>/seed_<n>
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    row |= {
        "state": state_of(run),
        "name": config["name"],
        "task": config["task"]["name"],
        "algorithm": run.parent.parent.name,
        "seed": config["seed"],
        "path": str(run),
    }
    known = {}
    if row["state"] == "done":
        known = json.loads((run / EVALUATION_FILE).read_text())
    elif (run / "metrics.csv").exists():
        known = _last_row(run / "metrics.csv")
    return row | {name: known[name] for name in COLUMNS[5:10] if name in known}


def select_runs(runs: Iterable[Path], wanted: Mapping[str, str]) -> list[Path]:
    """Runs whose state or configuration has all the wanted values.

    Args:
        runs: Run directories.
        wanted: Texts by dotted name, as ``{"state": "done", "task.sea": "calm"}``.

    Raises:
        ValueError: If a name is in no run's configuration.

    Examples:
        >>> select_runs([], {})
        []
    """
    configs = {run: json.loads((run / "config.json").read_text()) for run in runs}
    for name in wanted:
        found = [_value(config, name) is not _MISSING for config in configs.values()]
        if name != "state" and found and not any(found):
            raise ValueError(f"{name!r} is in no run's configuration")

    def matches(run: Path, name: str, text: str) -> bool:
        value = state_of(run) if name == "state" else _value(configs[run], name)
        return value is not _MISSING and text in (str(value), json.dumps(value))

    return [run for run in configs if all(matches(run, *item) for item in wanted.items())]


def format_table(rows: list[dict[str, Any]], columns: Iterable[str] = COLUMNS) -> str:
    """Rows as text, a line each, under the names of the columns."""
    names = list(columns)
    cells = [names, *([_text(row[name]) for name in names] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = (
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))
        for line in cells
    )
    return "\n".join(line.rstrip() for line in lines)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < 10 else f"{value:.0f}"
    return str(value)


def _value(config: Any, name: str) -> Any:
    for part in name.split("."):
        if not isinstance(config, dict) or part not in config:
            return _MISSING
        config = config[part]
    return config


def _last_row(path: Path) -> dict[str, Any]:
    # Whole lines only: a run may be writing the last one.
    header, *rows = path.read_text().rpartition("\n")[0].splitlines() or [""]
    if not rows:
        return {}
    cells = dict(zip(header.split(","), rows[-1].split(","), strict=False))
    known = {name: float(text) for name, text in cells.items() if text}
    return {n: int(v) if n.endswith("steps") else v for n, v in known.items()}


def _is_locked(path: Path) -> bool:
    if not path.exists():
        return False
    with open(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
