"""A run whose files are damaged and put back."""

from __future__ import annotations

import pytest

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.pictures import figures
from gdrl_torchrl.runs import evaluate as evaluation
from gdrl_torchrl.runs.run import run_experiment
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
