"""Read what a run left in its directory."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

METRICS_FILE = "metrics.csv"
EVALUATION_FILE = "evaluation.json"
TRAJECTORIES_FILE = "trajectories.npz"


def read_metrics(run_dir: str | Path) -> dict[str, np.ndarray]:
    """Read the table of training, one row per iteration.

    Args:
        run_dir: Directory of the run.

    Returns:
        Columns by name, float64 ``[R]``; NaN where a cell is blank.

    Raises:
        FileNotFoundError: If there is no ``metrics.csv``.
        ValueError: If a cell is not a number.
    """
    path = Path(run_dir) / METRICS_FILE
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        names = reader.fieldnames or ()
        # A run that was killed may leave a short last row: what is missing is blank.
        rows = [
            [
                _number(row[name], f"{name} in line {reader.line_num} of {path}")
                for name in names
            ]
            for row in reader
        ]
    table = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
    return {name: table[:, column].copy() for column, name in enumerate(names)}


def read_evaluation(run_dir: str | Path) -> dict[str, Any]:
    """Read the result of the held-out evaluation.

    Args:
        run_dir: Directory of the run.

    Raises:
        FileNotFoundError: If there is no ``evaluation.json``.
    """
    return json.loads((Path(run_dir) / EVALUATION_FILE).read_text())


def read_trajectories(run_dir: str | Path) -> dict[str, np.ndarray]:
    """Read the recorded episodes.

    Args:
        run_dir: Directory of the run.

    Returns:
        Arrays by name, see :func:`gdrl_torchrl.training.video.record_trajectories`.

    Raises:
        FileNotFoundError: If there is no ``trajectories.npz``.
    """
    with np.load(Path(run_dir) / TRAJECTORIES_FILE) as file:
        return {name: file[name] for name in file.files}


def _number(text: str | None, what: str) -> float:
    if text is None or not text.strip():
        return float("nan")
    try:
        return float(text)
    except ValueError as error:
        raise ValueError(f"{what}: {text!r} is not a number") from error
