"""Worlds other than those of a study's task, and how a run's final policy does there."""

from __future__ import annotations

from pathlib import Path

from gdrl_torchrl.agents.registry import make_actor
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.config.task import make_task_from_config
from gdrl_torchrl.files.policy import load_policy
from gdrl_torchrl.runs.evaluate import evaluate_policy

RATES = ("success_rate", "success_rate_sampled", "collision_rate", "timeout_rate")
"""What is noted of a policy elsewhere."""


def evaluate_elsewhere(run: Path, config: ExperimentConfig) -> dict[str, float]:
    """Run a run's final policy on as many held-out worlds of another task.

    Args:
        run: Directory of the run.
        config: What it was trained with, but with the other task.

    Returns:
        The :data:`RATES`, by name.

    Raises:
        ValueError: If the policy's file is missing or damaged.
    """
    task = make_task_from_config(config.task)
    actor = make_actor(task, config.network, config.algorithm)
    load_policy(run / "final", actor)
    scores = evaluate_policy(
        task,
        actor,
        config.evaluation,
        backend=config.task.backend,
        num_threads=config.simulation.num_threads,
    )
    return {name: scores[name] for name in RATES}
