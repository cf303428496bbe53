"""Runs so small that they can be started, killed and broken many times."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import gdrl_torchrl.conf
import pytest

from gdrl_torchrl.cli.compose import load_experiment
from gdrl_torchrl.config.evolution import ErlConfig

ROWS = 90
FRAMES = 40
ALL = [
    "evaluation.episodes=3",
    "evaluation.num_worlds=2",
    "logger.video_episodes=0",
    "task.step_limit=8",
    "task.goal_tolerance_m=0.5",
    "network.actor_cells=[8,8]",
]
# So near that some get there: a population without differences hands nothing over.
OF_TASK = {
    "indoor": [],
    "water": [
        "task.sea=calm",
        "task.goal_distance_m=[0.7,1.2]",
        "task.goal_tolerance_m=0.6",
        "task.step_limit=12",
    ],
}
LEARNER = ["algorithm.num_worlds=4", f"algorithm.frames_per_batch={FRAMES}"]
OF_ALGORITHM = {
    "ppo": [*LEARNER, "algorithm.minibatch_size=20", "algorithm.num_epochs=1"],
    "rainbow": [
        *LEARNER,
        "algorithm.minibatch_size=16",
        "algorithm.updates_per_batch=2",
        "algorithm.num_steps=3",
        "algorithm.num_atoms=11",
        "algorithm.warmup_steps=60",
        "algorithm.replay_capacity=200",
    ],
    "ga": [
        "algorithm.population_size=4",
        "algorithm.num_parents=2",
        "algorithm.num_validated=2",
        "algorithm.num_trials=2",
        "algorithm.validation_trials=2",
    ],
}
ERL = ["evolution.population_size=4", "evolution.num_elites=1", "evolution.num_trials=2"]
# Children so different that some are better: there are hand-overs.
GENETIC = [
    "evolution.num_children=3",
    "evolution.num_trials=2",
    "evolution.period_episodes=8",
    "evolution.mut_v=1.0",
    "evolution.screening_trials=1",
    "evolution.test_trials=2",
]


def pytest_generate_tests(metafunc):
    """A test with an argument ``any_experiment`` runs for each but the two longest."""
    if "any_experiment" in metafunc.fixturenames:
        folder = Path(gdrl_torchrl.conf.__path__[0], "experiment")
        names = {path.stem for path in folder.glob("*.yaml")}
        others = sorted(names - {"grainbow_indoor", "gppo_water"})
        metafunc.parametrize("any_experiment", others)


@pytest.fixture
def options_of():
    """Overrides that make an experiment small: some 90 rows in a few seconds."""

    def options(experiment):
        config = load_experiment([f"experiment={experiment}"])
        chosen = [f"experiment={experiment}", *ALL, *OF_TASK[config.task.name]]
        chosen += OF_ALGORITHM[config.algorithm.name]
        if config.evolution.enabled:
            chosen += ERL if isinstance(config.evolution, ErlConfig) else GENETIC
        # An evaluation a row, where there is no agent.
        total = 3000 if config.algorithm.name == "ga" else "null"
        budget = [f"budget.total_steps={total}", f"budget.agent_steps={ROWS * FRAMES}"]
        return [*chosen, *budget]

    return options


@pytest.fixture
def rows_of():
    def rows(run):
        """Rows of a run's metrics, without the clock."""
        with (run / "metrics.csv").open(newline="") as file:
            return [{**row, "wall_s": None} for row in csv.DictReader(file)]

    return rows


@pytest.fixture
def evaluation_of():
    """A run's evaluation, without the clock."""
    return lambda run: json.loads((run / "evaluation.json").read_text()) | {"wall_s": None}
