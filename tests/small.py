"""What makes an experiment small, in one place for all tests."""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Iterable
from typing import Any

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.config.study import Hypothesis, StudyConfig, StudyMethod
from gdrl_torchrl.evolution.settings import ErlConfig, EvolutionConfig, RaceConfig

EASY_WATER = {
    "sea": "calm",
    "goal_distance_m": [0.7, 1.2],
    "goal_tolerance_m": 0.6,
    "step_limit": 12,
}
"""Water that an untrained network often crosses; without waves nothing is chaotic."""

TASKS = {"water": EASY_WATER, "indoor": {"goal_tolerance_m": 0.5, "step_limit": 8}}
LEARNER = {"num_worlds": 4, "frames_per_batch": 40}
ALGORITHMS = {
    "ppo": {**LEARNER, "minibatch_size": 20, "num_epochs": 1},
    "rainbow": {
        **LEARNER,
        "minibatch_size": 16,
        "updates_per_batch": 2,
        "num_steps": 3,
        "num_atoms": 11,
        "warmup_steps": 60,
        "replay_capacity": 200,
    },
    "ga": {
        "population_size": 4,
        "num_parents": 2,
        "num_validated": 2,
        "num_trials": 2,
        "validation_trials": 2,
    },
}
GENETIC = {
    "num_children": 3,
    "num_trials": 2,
    "period_episodes": 8,
    "screening_trials": 1,
    "test_trials": 2,
}
ERL = {"population_size": 4, "num_elites": 1, "num_trials": 2}
RACE = {
    "num_members": 4,
    "num_trials": 2,
    "num_distilled": 2,
    "distillation_updates": 5,
    "race_below": 0.9,
    "patience_episodes": 8,
}
EVOLUTIONS = {EvolutionConfig: GENETIC, ErlConfig: ERL, RaceConfig: RACE}
OTHERS = {
    "evaluation": {"episodes": 3, "num_worlds": 2},
    "logger": {"video_episodes": 0},
    "network": {"actor_cells": [8, 8]},
}
TINY = (
    "evolution.num_children=2",
    "evolution.period_episodes=4",
    "evolution.window_episodes=4",
    "budget.agent_steps=120",
    "logger.tensorboard=false",
    "simulation.num_threads=1",
)
"""A run of three rows, with evaluations of its population: a second."""


@functools.cache
def _composed(overrides: tuple[str, ...]) -> ExperimentConfig:
    return load_experiment(list(overrides))


def compose(overrides: Iterable[str]) -> ExperimentConfig:
    """Like ``load_experiment``, which takes a third of a second, once for each of them.

    Where a run is put, which differs from test to test, is set afterwards.
    """
    chosen = tuple(overrides)
    places = [o.partition("=")[2] for o in chosen if o.startswith("runs_dir=")]
    config = _composed(tuple(o for o in chosen if not o.startswith("runs_dir=")))
    config = copy.deepcopy(config)
    return dataclasses.replace(config, runs_dir=places[-1]) if places else config


def as_overrides(group: str, options: dict[str, Any]) -> list[str]:
    """The options of a group as arguments of a command."""
    return [f"{group}.{name}={value}".replace(" ", "") for name, value in options.items()]


def small_options(experiment: str) -> list[str]:
    """Overrides that make an experiment small; it has 40 steps of the agent a row."""
    chosen = [f"experiment={experiment}"]
    config = compose(chosen)
    parts = OTHERS | {
        # An episode is short in every task; see easy_task for a task that is easy, too.
        "task": TASKS["indoor"],
        "algorithm": ALGORITHMS[config.algorithm.name],
    }
    if config.evolution.enabled:
        parts["evolution"] = EVOLUTIONS[type(config.evolution)]
    return [*chosen, *(x for part in parts.items() for x in as_overrides(*part))]


def easy_options(task: str) -> list[str]:
    """Overrides that make a task easy: an untrained policy often gets to its goal."""
    return as_overrides("task", TASKS[task])


def tiny_options(experiment: str, overrides: Iterable[str] = ()) -> list[str]:
    """Overrides that make a run of a second of an experiment with a genetic hook."""
    task = compose([f"experiment={experiment}"]).task.name
    return [*small_options(experiment), *easy_options(task), *TINY, *overrides]


def toy_study(**options) -> StudyConfig:
    """A study of two methods, one task and two seeds, whose runs take a second."""
    return StudyConfig(
        **{
            "name": "toy",
            "tasks": {"easy": ["task=water", "task.sea=calm"]},
            "methods": {
                "gppo": StudyMethod(["easy"], tiny_options("gppo_water")),
                "ppo": StudyMethod(["easy"], tiny_options("ppo_water")),
            },
            "total_steps": {"easy": 400},
            "seeds": [3, 4],
            "num_policies": 4,
            "episodes": 3,
            "hypotheses": [Hypothesis("better", "easy", "gppo", "ppo", "greater")],
            **options,
        }
    )
