"""``evaluation.json``: the held-out result of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gdrl_torchrl.files.fields import COUNT, SOME, TEXT, read_object
from gdrl_torchrl.files.metrics import KINDS

CONFIG_FILE = "config.json"


EVALUATION_FILE = "evaluation.json"


_EVALUATION = {
    "task": TEXT,
    "algorithm": TEXT,
    "seed": COUNT,
    "episodes": SOME,
    **{name: KINDS[name] for name in ("success_rate", "agent_steps", "total_steps")},
    "wall_s": KINDS["wall_s"],
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
