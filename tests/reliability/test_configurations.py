"""Any configuration runs, or is refused with the name of what is wrong."""

from __future__ import annotations

import collections
import dataclasses
import functools
import math
import sys
import typing
from importlib import resources

import pytest
import torch
from hypothesis import HealthCheck, event, given, note, settings
from hypothesis import strategies as st

from gdrl_tasks import task_options
from gdrl_torchrl.agents.registry import ALGORITHMS
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.config.task import task_config_class
from gdrl_torchrl.evolution.settings import ErlConfig, EvolutionConfig, RaceConfig
from gdrl_torchrl.runs.build import build_training
from gdrl_torchrl.runs.checkpoint import seed_everything
from gdrl_torchrl.runs.evaluate import evaluate_policy
from tests import small
from tests.config.fields import PARTS, REFUSAL, scalars_of, types_of

KINDS = sorted(
    entry.name.removesuffix(".yaml")
    for entry in resources.files("gdrl_torchrl.conf").joinpath("evolution").iterdir()
    if entry.name.endswith(".yaml")
)
SYSTEMS = [
    *((algorithm, kind) for algorithm in ("ppo", "rainbow") for kind in KINDS),
    *[("ga", "none")] * 4,
    ("ga", "genetic"),
]
SMALL = {
    **small.ALGORITHMS,
    **small.TASKS,
    **small.OTHERS,
    "genetic": {**small.GENETIC, "window_episodes": 4},
    "erl": {**small.ERL, "period_episodes": 8},
    "race": small.RACE,
    "simulation": {"num_threads": 1},
    "budget": {"total_steps": 1000},
}
"""What is taken where nothing else is drawn: ten iterations take a second or two."""
SIZES = {EvolutionConfig: "genetic", ErlConfig: "erl", RaceConfig: "race"}
COUNTS = (1, 2, 3, 5, 7)
ORDINARY = {
    "algorithm.num_worlds": (1, 2, 5, 8),
    "algorithm.frames_per_batch": (8, 16, 20, 40),
    "algorithm.minibatch_size": (2, 7, 13, 39, 40),
    "algorithm.num_epochs": (1, 2, 3),
    "algorithm.updates_per_batch": (1, 3, 5),
    "algorithm.num_steps": (1, 2, 8, 9),
    "algorithm.num_atoms": (2, 3, 51, 1000),
    "algorithm.replay_capacity": (7, 40, 64, 10_000),
    "algorithm.warmup_steps": (1, 41, 200, 10_000),
    "algorithm.population_size": (2, 3, 5),
    "algorithm.num_validated": (0, 1, 3),
    "evolution.rates": ([0.5, 0.2, 0.1], [0.2], [1.0, 0.0]),
    "evolution.thresholds": ([0.4, 0.8], [], [0.5], [0.0, 1.0], [0.8, 0.4]),
    "evolution.success_range": ([0.0, 1.0], [0.2, 0.9], [0.5, 0.5], [0.9, 0.2]),
    "evolution.mutation": ("bernoulli", "pseudocode", "scaled"),
    "evolution.crossover": ("none", "n_point"),
    "evolution.tie_rule": ("return_then_parent", "parent", "child", "none"),
    "evolution.num_points": (1, 2, 1000),
    "evolution.divergence": (None, 0.001, 0.1, 10.0),
    "evolution.divergence_rows": (1, 7, 1_000_000),
    "evolution.period_episodes": (1, 4, 8, 1_000_000),
    "evolution.window_episodes": (1, 4, 1_000_000),
    "evolution.population_size": (3, 4, 6),
    "evolution.num_looks": (1, 2, 4),
    "evolution.tournament_size": (1, 3, 1000),
    "evolution.name": ("genetic", "soft", "a/b"),
    "network.actor_cells": ([8], [1], [3, 5, 4], [4] * 17, []),
    "network.critic_cells": ([8], [1], [3, 5, 4], [4] * 17, []),
    "evaluation.num_worlds": (1, 2, 9),
    "simulation.num_threads": (0, 1, 2, 1024),
    "budget.total_steps": (1000, None),
    "budget.agent_steps": (1000, None),
    "budget.wall_s": (1000.0, None),
    "seed": (0, 1, 2**32, 2**62),
    "task.goal_distance_m": ([0.7, 1.2], [1.0, 1.0], [2.0, 1.0], [5000.0, 1e4], [1.0]),
    "task.goal_tolerance_m": (0.05, 0.3, 0.5, 0.69, 0.7),
    "task.turn_rates_deg_s": ([-90.0, 90.0], [-180.0, 0.0, 180.0], [0.0, 0.0], [0.0]),
    "task.extra_observations": ([], ["roll"], ["velocity", "time_left"], ["fuel"]),
    "task.control_interval_s": (0.25, 0.125, 0.12, 0.5, 0.3),
    "task.substep_s": (0.03125, 0.02, 0.0625, 0.1),
    "task.step_limit": (1, 2, 5, 8),
    "task.wave_components": (1, 5, 30),
    "task.num_beams": (1, 2, 19),
    "task.backend": ("batch", "batch", "dm_control", "mjx"),
}
"""Values that are cheap, or refused; other counts are :data:`COUNTS`."""
ABSURD = (-1, 0, 10**30, -1e30, math.nan, math.inf, True, "many", None, 2.5, [])


@functools.cache
def values_of(dotted, owner, name):
    """Ordinary values of a field, and its ends where they are cheap."""
    if dotted == "task.backend":
        return st.sampled_from(ORDINARY[dotted])
    (field,) = (field for field in dataclasses.fields(owner) if field.name == name)
    kind, choices = types_of(owner)[name], field.metadata.get("choices", ())
    bounds = field.metadata.get("range")
    ordinary = list(ORDINARY.get(dotted, choices))
    ends = []
    if typing.get_origin(kind) is typing.Literal:
        ordinary += typing.get_args(kind)
    elif bool in scalars_of(kind):
        ordinary += [True, False]
    elif not ordinary and int in scalars_of(kind):
        ordinary += COUNTS
    elif not ordinary and float in scalars_of(kind):
        low, high = max(bounds.least, bounds.above), min(bounds.most, bounds.below)
        ordinary += [low + share * (high - low) for share in (0.01, 0.1, 0.5)]
        if bounds.above == low:
            low = math.nextafter(low, high)
        if bounds.below == high:
            high = math.nextafter(high, low)
        ends += [low, high]
    if not ordinary:
        ordinary = [field.default]
    return st.sampled_from(ordinary) | st.sampled_from(ends or ordinary)


@functools.cache
def shipped(kind):
    """The settings of an evolution, and its class."""
    config = load_experiment([f"evolution={kind}"]).evolution
    return type(config), dataclasses.asdict(config)


@st.composite
def arguments(draw):
    """Classes of a configuration's groups, and what they are made with."""
    algorithm, kind = draw(st.sampled_from(SYSTEMS))
    task = draw(st.sampled_from(["water", "indoor"]))
    evolution, settings_of_kind = shipped(kind)
    size = SMALL[SIZES[evolution]]
    actions = {"any": draw(st.sampled_from(["discrete", "continuous"]))}
    needed = ALGORITHMS[algorithm].actions
    made = {
        "algorithm": (ALGORITHMS[algorithm], dict(SMALL[algorithm])),
        "evolution": (evolution, settings_of_kind | size),
        "task": (
            task_config_class(task),
            SMALL[task] | {"actions": actions.get(needed, needed)},
        ),
        **{name: (owner, dict(SMALL.get(name, {}))) for name, owner in PARTS.items()},
        "": (ExperimentConfig, {}),
    }
    fields = [
        (group, field.name)
        for group, (owner, _) in made.items()
        for field in dataclasses.fields(owner)
        if field.name not in (*made, "runs_dir")
        and (group, field.name) not in (("task", "name"), ("algorithm", "name"))
    ]
    for group, name in draw(st.lists(st.sampled_from(fields), max_size=8, unique=True)):
        owner = task_options(task) if group == "task" else made[group][0]
        dotted = f"{group}.{name}" if group else name
        made[group][1][name] = draw(values_of(dotted, owner, name))
    if draw(st.sampled_from([False, False, False, True])):
        group, name = draw(st.sampled_from(fields))
        made[group][1][name] = draw(st.sampled_from(ABSURD))
    return made


def configure(made):
    """A configuration of :func:`arguments`.

    Raises:
        ValueError: If it is refused.
    """
    parts = {group: owner(**options) for group, (owner, options) in made.items() if group}
    return ExperimentConfig(**parts, **made[""][1])


def run_ten_iterations(config):
    """Train, then evaluate."""
    seed_everything(config.seed)
    training = build_training(config)
    loop, iterations = training.loop, []

    def count():
        iterations.append(len(iterations))
        if len(iterations) == 10:
            loop.request_stop()

    loop.register_op("post_steps", count)
    try:
        loop.train()
        scores = evaluate_policy(
            training.task,
            training.agent.actor,
            config.evaluation,
            backend=config.task.backend,
            num_threads=1,
        )
    finally:
        training.close()
    assert len(iterations) == 10
    assert math.isfinite(scores["return_mean"])
    for parameter in training.agent.actor.parameters():
        assert torch.isfinite(parameter).all()


def assert_names_what_is_wrong(said, made):
    """An error is about fields: ``name=value must ...``."""
    match = REFUSAL.fullmatch(said)
    assert match, said
    name = match[1]
    group, _, field = name.rpartition(".")
    group = "task" if said.startswith("task: ") else group
    owner, options = made[group]
    assert field in {field.name for field in dataclasses.fields(owner)}, said
    value = options.get(field, getattr(owner, field, None))
    if isinstance(value, str | int | float):
        assert f"{name}={value!r}" in said


@pytest.mark.parametrize(
    "examples", [pytest.param(8), pytest.param(200, marks=pytest.mark.full)]
)
def test_any_configuration_runs_or_is_refused(examples):
    ended = collections.Counter()

    @given(made=arguments())
    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    def try_one(made):
        note(str({group: options for group, (_, options) in made.items()}))
        try:
            config = configure(made)
            make_task_of(config)
        except ValueError as error:
            assert_names_what_is_wrong(str(error), made)
            ended["refused"] += 1
            event("refused")
            return
        run_ten_iterations(config)
        ended["ran"] += 1
        event("ran")

    try_one()
    sys.stdout.write(f"{dict(ended)}\n")
    assert ended["ran"] >= examples / 4, ended
    assert ended["refused"] >= examples / 4, ended
