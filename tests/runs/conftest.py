"""Runs that several tests compare with."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.pictures import figures
from gdrl_torchrl.runs.place import run_key
from gdrl_torchrl.runs.run import run_experiment


@pytest.fixture(scope="session")
def whole_of(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[ExperimentConfig], Path]:
    """Gives the run of a configuration that nothing interrupted; made once, only read."""
    made: dict[str, Path] = {}

    def whole(config: ExperimentConfig) -> Path:
        key = f"{config.name} {run_key(config)} {config.seed} {config.budget}"
        if key not in made:
            runs_dir = str(tmp_path_factory.mktemp("whole"))
            with pytest.MonkeyPatch.context() as patch:
                for name in ("draw_learning_curve", "draw_trajectories"):
                    patch.setattr(figures, name, lambda path: None)
                made[key] = run_experiment(dataclasses.replace(config, runs_dir=runs_dir))
        return made[key]

    return whole
