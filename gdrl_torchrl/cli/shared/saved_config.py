"""The configuration that a run has saved, as far as its policy needs it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gdrl_torchrl.agents.registry import algorithm_configs
from gdrl_torchrl.agents.settings import NetworkConfig
from gdrl_torchrl.checks import check_choice
from gdrl_torchrl.cli.shared.compose import check_plain
from gdrl_torchrl.config.schema import EvaluationConfig, ExperimentConfig
from gdrl_torchrl.config.task import task_config_class
from gdrl_torchrl.files.fields import OBJECT, TEXT

READ = {
    "task": OBJECT,
    "task.name": TEXT,
    "algorithm": OBJECT,
    "algorithm.name": TEXT,
    "network": OBJECT,
    "evaluation": OBJECT,
}


def config_of(saved: dict[str, Any]) -> ExperimentConfig:
    """What an evaluation needs of a saved configuration.

    Raises:
        ValueError: If a field is missing, unknown or not what it must be.
    """
    check_plain(saved["task"])
    algorithms = algorithm_configs()
    check_choice("algorithm.name", saved["algorithm"]["name"], algorithms)
    classes = {
        "task": task_config_class(saved["task"]["name"]),
        "algorithm": algorithms[saved["algorithm"]["name"]],
        "network": NetworkConfig,
        "evaluation": EvaluationConfig,
    }
    return ExperimentConfig(
        **{name: _section(cls, name, saved[name]) for name, cls in classes.items()}
    )


def _section(cls: type, name: str, values: dict[str, Any]) -> Any:
    names = {field.name for field in dataclasses.fields(cls)}
    if missing := sorted(names - values.keys()):
        raise ValueError(f"{name} has no {missing}")
    if unknown := sorted(values.keys() - names):
        raise ValueError(f"{name} has {unknown}, which are unknown")
    return cls(**values)


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Name a file in the errors of what is made of it."""
    try:
        yield
    # Options of other packages may be unchecked, and libraries raise what they like.
    except (ValueError, TypeError, ArithmeticError, RuntimeError, MemoryError) as error:
        raise ValueError(f"{path}: {error}") from error
