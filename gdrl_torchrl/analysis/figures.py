"""Figures of one run: how it learned, and where its vehicles went."""

from __future__ import annotations

from pathlib import Path

from gdrl_torchrl.analysis import style
from gdrl_torchrl.analysis.learning_curve import make_learning_curve
from gdrl_torchrl.analysis.run_files import (
    EVALUATION_FILE,
    read_evaluation,
    read_metrics,
    read_trajectories,
)
from gdrl_torchrl.analysis.trajectories import make_trajectories


def draw_learning_curve(run_dir: str | Path) -> Path:
    """Write ``figures/learning_curve.png`` of a run.

    Success rate over all environment steps, over the agent's own and over time, with
    the genetic evaluations, their mutation probability and the held-out success.

    Args:
        run_dir: Directory with ``metrics.csv`` and, once it is there,
            ``evaluation.json``.

    Returns:
        The file written.
    """
    run_dir = Path(run_dir)
    has_evaluation = (run_dir / EVALUATION_FILE).exists()
    evaluation = read_evaluation(run_dir) if has_evaluation else None
    figure = make_learning_curve(read_metrics(run_dir), evaluation)
    return style.save(figure, run_dir / "figures" / "learning_curve.png")


def draw_trajectories(run_dir: str | Path) -> Path:
    """Write ``figures/trajectories.png`` of a run.

    Args:
        run_dir: Directory with ``trajectories.npz``.

    Returns:
        The file written.
    """
    figure = make_trajectories(read_trajectories(run_dir))
    return style.save(figure, Path(run_dir) / "figures" / "trajectories.png")
