"""Every run below a folder: what it is, how far it came, and what it cost."""

from __future__ import annotations

import difflib
import fcntl
import json
import logging
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gdrl_torchrl.files.evaluation import CONFIG_FILE, EVALUATION_FILE
from gdrl_torchrl.files.fields import COUNT, SWITCH, TEXT, read_object
from gdrl_torchrl.files.metrics import KINDS, METRICS_FILE, read_row, split_lines
from gdrl_torchrl.labels import algorithm_label

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
_CONFIG = {
    "name": TEXT,
    "task.name": TEXT,
    "algorithm.name": TEXT,
    "evolution.name": TEXT,
    "evolution.enabled": SWITCH,
    "seed": COUNT,
}
_ALSO = {"task": "task.name", "algorithm": "algorithm.name"}
"""Columns that are named like a whole part of the configuration."""
_KNOWN = {name: KINDS[name] for name in COLUMNS if name in KINDS}
_logger = logging.getLogger(__name__)


def find_runs(folder: str | Path) -> list[Path]:
    """Run directories below a folder, in the order of their names.

    What is inside a run is left alone: checkpoints of one that is training come and go.
    Folders that cannot be read are named in warnings.
    """
    runs = []
    for path, folders, files in os.walk(folder, onerror=_warn):
        if CONFIG_FILE in files:
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
    """A run as a row of the table; None where nothing is known yet.

    The state of a run with a file that cannot be used is ``damaged``, and ``damage``,
    which else is None, names the file and says what is wrong.
    """
    row: dict[str, Any] = dict.fromkeys((*COLUMNS, "damage"))
    row["path"] = str(run)
    try:
        row["state"] = state_of(run)
        config = read_object(run / CONFIG_FILE, _CONFIG)
        row |= {"name": config["name"], "seed": config["seed"]}
        row |= {"task": config["task"]["name"], "algorithm": _label(config)}
        row |= _results(run, row["state"])
    except (OSError, ValueError) as error:
        row |= {"state": "damaged", "damage": str(error)}
    return row


def select_runs(runs: Iterable[Path], wanted: Mapping[str, str]) -> list[Path]:
    """Runs whose state or configuration has all the wanted values.

    A run whose configuration cannot be read is among them: its row says what is wrong.

    Args:
        runs: Run directories.
        wanted: Texts by dotted name, as ``{"state": "done", "task.sea": "calm"}``;
            ``algorithm`` and ``task`` are the columns of the table, and
            ``algorithm.name`` may be what its column says too.

    Raises:
        ValueError: If a name is in no run's configuration.

    Examples:
        >>> select_runs([], {})
        []
    """
    configs = {run: _readable_config(run) for run in runs}
    known = [config for config in configs.values() if config is not None]
    for name in wanted:
        if known and name != "state" and not any(_values(c, name) for c in known):
            near = difflib.get_close_matches(name, _names(known), n=1)
            hint = f": did you mean {near[0]}?" if near else ""
            text = f"{name}={wanted[name]} must be an option of a run that is here{hint}"
            raise ValueError(text)

    def matches(run: Path, name: str, text: str) -> bool:
        config = configs[run]
        if config is None:
            return True
        return text in ([state_of(run)] if name == "state" else _values(config, name))

    return [run for run in configs if all(matches(run, *item) for item in wanted.items())]


def values_of(runs: Iterable[Path], name: str) -> list[str]:
    """The values that an option has in the configurations of runs, as texts in order."""
    configs = [config for run in runs if (config := _readable_config(run)) is not None]
    return sorted({text for config in configs for text in _values(config, name)[:1]})


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
    text = str(value)
    # A name may hold what would break the line, or could not be written at all.
    return text if text.isprintable() else ascii(text)


def _label(config: Mapping[str, Any]) -> str:
    evolution = config["evolution"]
    name = evolution["name"] if evolution["enabled"] else None
    return algorithm_label(config["algorithm"]["name"], name)


def _values(config: Mapping[str, Any], name: str) -> list[str]:
    """Texts that stand for the value of an option; none if there is no such option."""
    value: Any = config
    for part in _ALSO.get(name, name).split("."):
        if not isinstance(value, dict) or part not in value:
            return []
        value = value[part]
    if name == "algorithm":
        return [_label(config)]
    return [str(value), json.dumps(value)] + [_label(config)] * (name == "algorithm.name")


def _names(configs: Iterable[Mapping[str, Any]]) -> set[str]:
    """Names of all options of some configurations."""
    found = {"state", *_ALSO}
    for config in configs:
        for name, value in config.items():
            options = value if isinstance(value, dict) else ()
            found |= {name, *(f"{name}.{option}" for option in options)}
    return found


def _readable_config(run: Path) -> dict[str, Any] | None:
    try:
        # Its state may be wanted too.
        state_of(run)
        return read_object(run / CONFIG_FILE, _CONFIG)
    except (OSError, ValueError):
        return None


def _results(run: Path, state: str) -> dict[str, Any]:
    """What is known of success and costs."""
    if state == "done":
        required = {"success_rate": KINDS["success_rate"]}
        known = read_object(run / EVALUATION_FILE, required, _KNOWN)
    elif (run / METRICS_FILE).exists():
        known = _last_row(run / METRICS_FILE)
    else:
        known = {}
    return {name: known[name] for name in _KNOWN if name in known}


def _last_row(path: Path) -> dict[str, Any]:
    # Whole lines only: a run may be writing the last one.
    names, lines, _ = split_lines(path)
    if not lines:
        return {}
    row = read_row(names, lines[-1], len(lines) + 1, path)
    return {
        name: value for name, value in zip(names, row, strict=True) if value is not None
    }


def _warn(error: OSError) -> None:
    _logger.warning("%s", error)


def _is_locked(path: Path) -> bool:
    # To open a pipe would take for ever.
    if not path.is_file():
        return False
    with open(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
