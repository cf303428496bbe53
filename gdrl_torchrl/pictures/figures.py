"""Figures of one run: how it learned, and where its vehicles went."""

from __future__ import annotations

from pathlib import Path

from gdrl_torchrl.files.evaluation import EVALUATION_FILE, read_evaluation
from gdrl_torchrl.files.metrics import METRICS_FILE, read_metrics
from gdrl_torchrl.files.trajectories import TRAJECTORIES_FILE, read_trajectories
from gdrl_torchrl.pictures import style
from gdrl_torchrl.pictures.learning_curve import COLUMNS, make_learning_curve
from gdrl_torchrl.pictures.trajectories import make_trajectories


def draw_learning_curve(run_dir: str | Path) -> Path:
    """Write ``figures/learning_curve.png`` of a run.

    Success rate over all environment steps, over the agent's own and over time, with
    the genetic evaluations, their mutation probability and the held-out success.

    Args:
        run_dir: Directory with ``metrics.csv`` and, once it is there,
            ``evaluation.json``.

    Returns:
        The file written.

    Raises:
        FileNotFoundError: If there is no ``metrics.csv``.
        ValueError: If a file is damaged; the error names it.
    """
    run_dir = Path(run_dir)
    has_evaluation = (run_dir / EVALUATION_FILE).exists()
    evaluation = read_evaluation(run_dir) if has_evaluation else None
    metrics = read_metrics(run_dir)
    for name in COLUMNS:
        if name not in metrics:
            raise ValueError(f"{run_dir / METRICS_FILE} has no column {name}")
    figure = make_learning_curve(metrics, evaluation)
    return style.save(figure, run_dir / "figures" / "learning_curve.png")


def draw_trajectories(run_dir: str | Path) -> Path:
    """Write ``figures/trajectories.png`` of a run.

    Args:
        run_dir: Directory with ``trajectories.npz``.

    Returns:
        The file written.

    Raises:
        FileNotFoundError: If there is no ``trajectories.npz``.
        ValueError: If it is damaged; the error names it.
    """
    trajectories = read_trajectories(run_dir)
    unknown = set(trajectories["outcome_names"].tolist()) - style.OUTCOME_COLOURS.keys()
    if unknown:
        raise ValueError(
            f"{Path(run_dir) / TRAJECTORIES_FILE}: outcome_names has {sorted(unknown)}, "
            f"expected some of {list(style.OUTCOME_COLOURS)}"
        )
    figure = make_trajectories(trajectories)
    return style.save(figure, Path(run_dir) / "figures" / "trajectories.png")
