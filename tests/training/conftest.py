"""A run so small that it takes a second."""

from __future__ import annotations

import csv
import json

import pytest

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.pictures import figures
from gdrl_torchrl.runs.phases import PHASES

CLOCK = ("wall_s", *PHASES)

TINY_WATER = (
    "experiment=gppo_water",
    "task.sea=calm",
    "task.goal_distance_m=[0.7,1.2]",
    "task.goal_tolerance_m=0.6",
    "task.step_limit=12",
    "algorithm.minibatch_size=20",
    "algorithm.num_epochs=1",
    "network.actor_cells=[8]",
    "network.critic_cells=[8]",
)
TINY_INDOOR = (
    "experiment=grainbow_indoor",
    "task.num_beams=5",
    "task.goal_tolerance_m=0.5",
    "task.step_limit=8",
    "algorithm.minibatch_size=16",
    "algorithm.updates_per_batch=2",
    "algorithm.num_steps=3",
    "algorithm.num_atoms=11",
    "algorithm.warmup_steps=60",
    "algorithm.replay_capacity=100",
    "network.actor_cells=[8,8]",
    "evolution.experience_share=0.5",
)
TINY = (
    "algorithm.num_worlds=4",
    "algorithm.frames_per_batch=40",
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


def composer(base, tmp_path):
    def compose(*overrides):
        runs_dir = f"runs_dir={tmp_path / 'runs'}"
        return load_experiment([*base, *TINY, runs_dir, *overrides])

    return compose


@pytest.fixture
def tiny(tmp_path):
    """Composes a tiny configuration with further overrides: GPPO on the water."""
    return composer(TINY_WATER, tmp_path)


@pytest.fixture
def tiny_rainbow(tmp_path):
    """The same for GRainbow indoors."""
    return composer(TINY_INDOOR, tmp_path)


@pytest.fixture(params=[TINY_WATER, TINY_INDOOR], ids=["gppo", "grainbow"])
def tiny_of_each(request, tmp_path):
    """The same for both, one after the other."""
    return composer(request.param, tmp_path)


@pytest.fixture
def without_figures(monkeypatch):
    """Runs draw nothing: their figures have tests of their own."""
    for name in ("draw_learning_curve", "draw_trajectories"):
        monkeypatch.setattr(figures, name, lambda path: None)


@pytest.fixture
def rows_of():
    def read(path):
        """Rows of a run's metrics, without the clock."""
        with open(path / "metrics.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            for name in CLOCK:
                assert float(row.pop(name)) >= 0.0
        return rows

    return read


@pytest.fixture
def evaluation_of():
    return lambda path: json.loads((path / "evaluation.json").read_text())
