"""Configurations: every field has a type and a range; any of them runs or is refused."""

from __future__ import annotations

import collections
import dataclasses
import functools
import importlib
import math
import pkgutil
import re
import sys
import typing
from importlib import resources

import pytest
import torch
from hypothesis import HealthCheck, event, given, note, settings
from hypothesis import strategies as st

import gdrl_torchrl.config
from gdrl_tasks import task_names, task_options
from gdrl_torchrl.agents.registry import ALGORITHMS, algorithm_configs
from gdrl_torchrl.agents.settings import NetworkConfig
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.config.schema import BudgetConfig, ExperimentConfig
from gdrl_torchrl.config.search import SearchConfig
from gdrl_torchrl.config.task import task_config_class
from gdrl_torchrl.evolution.settings import EVOLUTIONS, ErlConfig
from gdrl_torchrl.runs.build import build_training
from gdrl_torchrl.runs.checkpoint import seed_everything
from gdrl_torchrl.runs.evaluate import evaluate_policy

# What every field is held to


def types_of(owner):
    return typing.get_type_hints(owner)


PARTS = {
    name: kind
    for name, kind in types_of(ExperimentConfig).items()
    if dataclasses.is_dataclass(kind)
}
"""The parts of an experiment that are always the same class, by group."""
CONFIGS = [
    ("", ExperimentConfig),
    ("search", SearchConfig),
    *PARTS.items(),
    *(("algorithm", config) for config in algorithm_configs().values()),
    *(("evolution", config) for config in EVOLUTIONS.values()),
    *(("", task_options(name)) for name in task_names()),
]
NEEDED = {
    SearchConfig: {"params": {"seed": "choice(0, 1)"}},
    BudgetConfig: {"agent_steps": 10},
}


def scalars_of(kind):
    """The types that a type is made of."""
    parts = typing.get_args(kind)
    if typing.get_origin(kind) is typing.Literal:
        return {str}
    return set().union(*map(scalars_of, parts)) if parts else {kind}


def is_sequence(kind):
    kinds = {typing.get_origin(kind), *map(typing.get_origin, typing.get_args(kind))}
    return bool(kinds & {list, tuple})


def fields_of(*wanted):
    """Every field of every configuration that is made of one of some types."""
    return [
        pytest.param(group, owner, field.name, kind, id=f"{owner.__name__}.{field.name}")
        for group, owner in CONFIGS
        for field in dataclasses.fields(owner)
        for kind in [types_of(owner)[field.name]]
        if scalars_of(kind) & set(wanted) and typing.get_origin(kind) is not dict
    ]


NUMBERS = fields_of(int, float)
WRONG_NUMBERS = (-(10**30), 10**30, -1e30, 1e30, math.nan, math.inf, -math.inf)
NO_NUMBERS = (True, "1", b"1", 1j, {}, object)


def refusal(group, owner, name, value):
    """What is said about a value; it names the field and the value."""
    start = f"{group}.{name}={value!r} must " if group else f"{name}={value!r} must "
    with pytest.raises(ValueError, match=f"^{re.escape(start)}") as refused:
        owner(**{**NEEDED.get(owner, {}), name: value})
    return str(refused.value)


def in_place(owner, name, kind, value):
    """A value as a field's, or as one element of a sequence."""
    if not is_sequence(kind):
        return value
    default = getattr(owner(**NEEDED.get(owner, {})), name)
    changed = [*default[:-1], value]
    return changed if isinstance(default, list) else tuple(changed)


def assert_bounds_are_named(said):
    assert re.search(r"(>|>=) -?\d\S* and (<|<=) -?\d", said), said


def test_no_configuration_is_forgotten():
    modules = [
        importlib.import_module(f"gdrl_torchrl.config.{module.name}")
        for module in pkgutil.iter_modules(gdrl_torchrl.config.__path__)
    ]
    found = {
        value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, type)
        and dataclasses.is_dataclass(value)
        and value.__module__ == module.__name__
    }
    assert found <= {config for _, config in CONFIGS}
    assert len(NUMBERS) > 80


@pytest.mark.parametrize(("group", "owner", "name", "kind"), NUMBERS)
def test_every_number_has_a_type_and_two_ends(group, owner, name, kind):
    for value in (*WRONG_NUMBERS, *NO_NUMBERS):
        said = refusal(group, owner, name, in_place(owner, name, kind, value))
        assert_bounds_are_named(said)


@pytest.mark.parametrize(("group", "owner", "name", "kind"), NUMBERS)
def test_the_ends_that_are_said_are_those_that_hold(group, owner, name, kind):
    whole = int in scalars_of(kind)
    (field,) = (field for field in dataclasses.fields(owner) if field.name == name)
    bounds = field.metadata["range"]
    outside = [
        bounds.least - 1 if whole else math.nextafter(bounds.least, -math.inf),
        bounds.most + 1 if whole else math.nextafter(bounds.most, math.inf),
        bounds.above,
        bounds.below,
    ]
    ends = [value for value in outside if math.isfinite(value)]
    assert len(ends) == 2
    for value in ends:
        said = refusal(group, owner, name, in_place(owner, name, kind, value))
        assert_bounds_are_named(said)


@pytest.mark.parametrize(("group", "owner", "name", "kind"), fields_of(int))
def test_counts_are_whole(group, owner, name, kind):
    refusal(group, owner, name, in_place(owner, name, kind, 2.0))


@pytest.mark.parametrize(("group", "owner", "name", "kind"), fields_of(bool, str))
def test_words_and_switches_have_their_type(group, owner, name, kind):
    for value in (1, 0.5, b"calm", []):
        refusal(group, owner, name, in_place(owner, name, kind, value))


@pytest.mark.parametrize("name", PARTS)
def test_a_part_is_of_its_class(name):
    refusal("", ExperimentConfig, name, {"episodes": 3})


def test_numbers_of_numpy_become_pythons():
    numpy = pytest.importorskip("numpy")
    config = ALGORITHMS["ppo"](num_worlds=numpy.int64(8), gamma=numpy.float32(0.5))
    assert (type(config.num_worlds), type(config.gamma)) == (int, float)
    options = task_options("indoor")(turn_rates_deg_s=numpy.array([-30.0, 30.0]))
    assert options.turn_rates_deg_s == (-30.0, 30.0)
    assert {type(rate) for rate in options.turn_rates_deg_s} == {float}


# What must hold between fields

REFUSAL = re.compile(r"(?:task: )?([a-z_]+(?:\.[a-z_]+)?)=\S.* must .+", re.DOTALL)
"""What an error says: the name of a field, its value and what must be."""
RAINBOW = "experiment=grainbow_indoor"
GA = "experiment=ga_water"


@pytest.mark.parametrize(
    "overrides",
    [
        "algorithm.num_worlds=7 algorithm.frames_per_batch=2048",
        "algorithm.minibatch_size=512 algorithm.frames_per_batch=256",
        f"{RAINBOW} algorithm.warmup_steps=300 algorithm.replay_capacity=256",
        f"{RAINBOW} algorithm.epsilon_end=0.5 algorithm.epsilon_start=0.2",
        f"{RAINBOW} algorithm.num_steps=9 task.step_limit=8",
        f"{RAINBOW} algorithm.num_steps=501 task.step_limit=null",
        f"{RAINBOW} evolution.critic_on_switch=reset",
        f"{GA} algorithm.population_size=20 algorithm.num_parents=21",
        f"{GA} algorithm.population_size=20 algorithm.num_validated=21",
        f"{GA} algorithm.population_size=20000 algorithm.num_trials=6",
        f"{GA} budget.agent_steps=100 budget.total_steps=null",
        f"{GA} evolution.enabled=true",
        "evolution.num_children=1000 evolution.num_trials=1000",
        "evolution.test_trials=1000 evolution.num_looks=11",
        "evolution.rates=[0.5] evolution.thresholds=[0.5]",
        "evolution=erl evolution.num_elites=3 evolution.population_size=4",
        "task.backend=dm_control seed=5000000",
        "task.goal_tolerance_m=2.5 task.goal_distance_m=[2.0,6.0]",
        "task.control_interval_s=0.3 task.substep_s=0.04",
        "budget.agent_steps=null",
        "network.actor_cells=[4096,4096] evolution.num_children=17",
        f"{GA} network.actor_cells=[4096,4096] algorithm.population_size=21",
    ],
)
def test_fields_that_exclude_each_other_are_named_together(overrides):
    with pytest.raises(ValueError, match="must") as refused:
        make_task_of(load_experiment(overrides.split()))
    said = str(refused.value)
    assert REFUSAL.fullmatch(said), said
    for name, value in re.findall(r"\w+\.(\w+)=(\S+)", overrides):
        assert name in said
        assert all(number in said for number in re.findall(r"[\d.]+", value)), said


@pytest.mark.parametrize("name", ["actor_cells", "critic_cells"])
def test_widths_that_are_large_together_are_refused(name):
    assert NetworkConfig(**{name: [16_384]})
    with pytest.raises(ValueError, match="must have at most 16777216 weights") as refused:
        NetworkConfig(**{name: [16_384] * 3})
    assert f"network.{name}=[16384, 16384, 16384]" in str(refused.value)


def test_an_experiment_needs_a_task_and_an_algorithm():
    config = load_experiment([])
    for name in ("task", "algorithm"):
        with pytest.raises(ValueError, match=f"{name}=None must be given"):
            make_task_of(dataclasses.replace(config, **{name: None}))


def test_a_population_larger_than_its_worlds_takes_turns():
    options = ["evolution.num_children=4", "evolution.num_trials=3", "task.step_limit=3"]
    training = build_training(load_experiment([*options, "evolution.num_worlds=2"]))
    evaluation = training.evolution.evaluate()
    training.close()
    assert evaluation.scores.batch_size == (5,)
    assert evaluation.population_steps == 5 * 3 * 3


# Random configurations

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
LEARNER = {"num_worlds": 4, "frames_per_batch": 40}
SMALL = {
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
        "population_size": 3,
        "num_parents": 2,
        "num_validated": 1,
        "num_trials": 2,
        "validation_trials": 2,
    },
    "water": {"goal_distance_m": [0.7, 1.2], "goal_tolerance_m": 0.6, "step_limit": 8},
    "indoor": {"num_beams": 5, "goal_tolerance_m": 0.5, "step_limit": 8},
    "genetic": {
        "num_children": 2,
        "num_trials": 2,
        "period_episodes": 8,
        "window_episodes": 4,
        "screening_trials": 1,
        "test_trials": 2,
    },
    "erl": {"population_size": 3, "num_elites": 1, "num_trials": 2, "period_episodes": 8},
    "network": {"actor_cells": [8, 8], "critic_cells": [8]},
    "evaluation": {"episodes": 2, "num_worlds": 2},
    "simulation": {"num_threads": 1},
    "budget": {"total_steps": 1000},
}
"""What is taken where nothing else is drawn: ten iterations take a second or two."""
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
    "evolution.mutation": ("bernoulli", "pseudocode", "scaled"),
    "evolution.crossover": ("none", "n_point"),
    "evolution.tie_rule": ("return_then_parent", "parent", "child", "none"),
    "evolution.num_points": (1, 2, 1000),
    "evolution.sensitivity_rows": (1, 7, 1_000_000),
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
    size = SMALL["erl" if evolution is ErlConfig else "genetic"]
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
    trainer, iterations = training.agent.trainer, []

    def count():
        iterations.append(len(iterations))
        if len(iterations) == 10:
            trainer.request_stop()

    trainer.register_op("post_steps", count)
    try:
        trainer.train()
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
    "examples", [pytest.param(15), pytest.param(200, marks=pytest.mark.full)]
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
