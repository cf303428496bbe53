"""A run whose files are damaged and put back, and a folder with checkpoints."""

from __future__ import annotations

import pytest

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.pictures import figures
from gdrl_torchrl.runs import evaluate as evaluation
from gdrl_torchrl.runs.run import run_experiment
from tests.reliability.files.states import State, checkpoints_of, content_of
from tests.small import tiny_options


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    runs_dir = tmp_path_factory.mktemp("runs")
    return load_experiment([*tiny_options("gppo_water"), f"runs_dir={runs_dir}"])


@pytest.fixture(scope="module")
def run(config, without_episodes):
    """A run directory; tests leave it as it was."""
    return run_experiment(config)


@pytest.fixture(scope="module")
def without_episodes():
    """An evaluation reads everything, and runs nothing; runs draw nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "evaluate_policy", lambda *a, **k: {})
        for name in ("draw_learning_curve", "draw_trajectories"):
            patch.setattr(figures, name, lambda path: None)
        yield


@pytest.fixture
def saved(tmp_path):
    """A folder with checkpoints of steps 10 and 20."""
    for step in (10, 20):
        checkpoints_of(tmp_path, State(content_of(step))).save(step)
    return tmp_path
