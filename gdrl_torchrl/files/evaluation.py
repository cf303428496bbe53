"""``evaluation.json``: the held-out result of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gdrl_torchrl.files.fields import (
    COUNT,
    OBJECT,
    RATE,
    SECONDS,
    SOME,
    TEXT,
    Kind,
    read_object,
)
from gdrl_torchrl.files.metrics import KINDS

CONFIG_FILE = "config.json"


EVALUATION_FILE = "evaluation.json"
CURVE_FILE = "curve.json"
"""Held-out success of the policies that a run has kept."""


_EVALUATION = {
    "task": TEXT,
    "algorithm": TEXT,
    "seed": COUNT,
    "episodes": SOME,
    **{name: KINDS[name] for name in ("success_rate", "agent_steps", "total_steps")},
    "wall_s": KINDS["wall_s"],
}


_CURVE = {
    "point": SOME,
    **dict.fromkeys(("agent_steps", "population_steps", "total_steps"), COUNT),
    "agent_episodes": COUNT,
    "wall_s": SECONDS,
    **dict.fromkeys(("success_rate", "success_rate_sampled"), RATE),
}


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


def read_curve(run_dir: str | Path) -> list[dict[str, Any]]:
    """Read the held-out success of the policies that a run has kept, in their order.

    Raises:
        FileNotFoundError: If the run has kept none, or has not ended.
        ValueError: If a field is missing or not what it must be.
    """
    path = Path(run_dir) / CURVE_FILE
    points = read_object(path, {"points": Kind("a list", lambda x: isinstance(x, list))})
    for point in points["points"]:
        OBJECT.check(point, f"{path}: points")
        for name, kind in _CURVE.items():
            kind.check(point.get(name), f"{path}: {name}")
    return points["points"]
