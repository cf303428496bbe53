"""A run so small that it takes a second."""

from __future__ import annotations

import csv
import json

import pytest

from gdrl_torchrl.cli.compose import load_experiment
from gdrl_torchrl.training import run

TINY = (
    "experiment=gppo_water",
    "task.sea=calm",
    "task.goal_distance_m=[0.7,1.2]",
    "task.goal_tolerance_m=0.6",
    "task.step_limit=12",
    "algorithm.num_worlds=4",
    "algorithm.frames_per_batch=40",
    "algorithm.minibatch_size=20",
    "algorithm.num_epochs=1",
    "network.actor_cells=[8]",
    "network.critic_cells=[8]",
    "evolution.num_children=2",
    "evolution.num_trials=2",
    "evolution.period_episodes=4",
    "evolution.window_episodes=4",
    "budget.agent_steps=120",
    "evaluation.episodes=3",
    "evaluation.num_worlds=2",
    "logger.tensorboard=false",
    "logger.video_episodes=0",
    "simulation.num_threads=1",
)


@pytest.fixture
def tiny(tmp_path):
    """Composes a tiny configuration with further overrides."""

    def compose(*overrides):
        return load_experiment([*TINY, f"runs_dir={tmp_path / 'runs'}", *overrides])

    return compose


@pytest.fixture
def without_figures(monkeypatch):
    """Runs draw nothing: their figures have tests of their own."""
    for name in ("draw_learning_curve", "draw_trajectories"):
        monkeypatch.setattr(run, name, lambda path: None)


@pytest.fixture
def rows_of():
    def read(path):
        """Rows of a run's metrics, without the clock."""
        with open(path / "metrics.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            assert float(row.pop("wall_s")) >= 0.0
        return rows

    return read


@pytest.fixture
def evaluation_of():
    return lambda path: json.loads((path / "evaluation.json").read_text())
