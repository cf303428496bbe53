"""Read what a run left in its directory; nothing in it is run as code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gdrl_torchrl.analysis.fields import COUNT, SOME, TEXT, read_object
from gdrl_torchrl.analysis.metrics_file import KINDS, read_row, read_rows, split_lines
from gdrl_torchrl.analysis.trajectories_file import check_trajectories, read_arrays

CONFIG_FILE = "config.json"
METRICS_FILE = "metrics.csv"
EVALUATION_FILE = "evaluation.json"
TRAJECTORIES_FILE = "trajectories.npz"

_EVALUATION = {
    "task": TEXT,
    "algorithm": TEXT,
    "seed": COUNT,
    "episodes": SOME,
    **{name: KINDS[name] for name in ("success_rate", "agent_steps", "total_steps")},
    "wall_s": KINDS["wall_s"],
}


def algorithm_label(algorithm: str, evolution: str | None) -> str:
    """What an agent with a population is called in tables and figures.

    Args:
        algorithm: Name of the agent's algorithm.
        evolution: Name of the evolution beside it; None if there is none.

    Examples:
        >>> [algorithm_label("ppo", e) for e in (None, "genetic", "erl")]
        ['ppo', 'gppo', 'erl_ppo']
    """
    if evolution is None:
        return algorithm
    return f"g{algorithm}" if evolution == "genetic" else f"{evolution}_{algorithm}"


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


def read_evaluation(run_dir: str | Path) -> dict[str, Any]:
    """Read the result of the held-out evaluation.

    Args:
        run_dir: Directory of the run.

    Raises:
        FileNotFoundError: If there is no ``evaluation.json``.
        ValueError: If it is not JSON, or a field that is drawn is missing or not what it
            must be.
    """
    return read_object(Path(run_dir) / EVALUATION_FILE, _EVALUATION)


def read_trajectories(run_dir: str | Path) -> dict[str, np.ndarray]:
    """Read the recorded episodes.

    Args:
        run_dir: Directory of the run.

    Returns:
        Arrays by name, see :func:`gdrl_torchrl.training.video.record_trajectories`.

    Raises:
        FileNotFoundError: If there is no ``trajectories.npz``.
        ValueError: If it is damaged, or an array is missing or not what it must be.
    """
    path = Path(run_dir) / TRAJECTORIES_FILE
    arrays = read_arrays(path)
    check_trajectories(arrays, path)
    return arrays
