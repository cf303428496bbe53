"""Runs so small that they only show that everything works."""

from __future__ import annotations

import dataclasses
from typing import Any

from gdrl_torchrl.agents.ga.settings import GAConfig
from gdrl_torchrl.agents.ppo.settings import PPOConfig
from gdrl_torchrl.agents.rainbow.settings import RainbowConfig
from gdrl_torchrl.config.schema import BudgetConfig, ExperimentConfig
from gdrl_torchrl.evolution.settings import ErlConfig, EvolutionConfig, RaceConfig

_SIZES: dict[type, dict[str, Any]] = {
    PPOConfig: {"frames_per_batch": 512, "num_epochs": 2},
    RainbowConfig: {"warmup_steps": 500},
    GAConfig: {
        "population_size": 3,
        "num_parents": 2,
        "num_validated": 1,
        "num_trials": 4,
        "validation_trials": 4,
    },
    EvolutionConfig: {
        "num_children": 2,
        "num_trials": 4,
        "period_episodes": 16,
        "screening_trials": 2,
        "test_trials": 4,
    },
    ErlConfig: {
        "population_size": 3,
        "num_elites": 1,
        "num_trials": 4,
        "period_episodes": 16,
    },
    RaceConfig: {
        "num_members": 6,
        "num_distilled": 2,
        "num_again": 2,
        "distillation_updates": 20,
    },
}


def as_toy(config: ExperimentConfig) -> ExperimentConfig:
    """The same system with a population of three and a few thousand steps.

    Nothing is learned; episodes are short, and 20 are evaluated.

    Examples:
        >>> from gdrl_torchrl.config.task import task_config_class
        >>> config = ExperimentConfig(task=task_config_class("water")())
        >>> as_toy(config).evaluation.episodes
        20
    """
    parts = {
        name: dataclasses.replace(part, **_SIZES.get(type(part), {}))
        for name in ("algorithm", "evolution")
        if (part := getattr(config, name)) is not None
    }
    return dataclasses.replace(
        config,
        **parts,
        task=dataclasses.replace(config.task, step_limit=60),
        budget=BudgetConfig(total_steps=4_000),
        evaluation=dataclasses.replace(config.evaluation, episodes=20, num_worlds=20),
        logger=dataclasses.replace(config.logger, video_episodes=0, tensorboard=False),
    )
