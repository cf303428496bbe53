"""Every shipped configuration works, and has the defaults of what it configures."""

from __future__ import annotations

import ast
import csv
import dataclasses
import inspect
from importlib import resources
from pathlib import Path

import pytest

from gdrl_tasks import make_task, task_names
from gdrl_torchrl.agents.networks import make_tanh_normal_actor, make_value_network
from gdrl_torchrl.agents.registry import ALGORITHMS
from gdrl_torchrl.cli.search import load_search
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config import schema
from gdrl_torchrl.config.task import make_task_from_config, task_config_class
from gdrl_torchrl.evolution.hooks.breeding import MutatedChildren
from gdrl_torchrl.evolution.hooks.contest import FullContest
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.hooks.hand_over import HandOver
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.evolution.operators.schedule import MutationSchedule
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.evolution.settings import EvolutionConfig
from gdrl_torchrl.runs.build import build_training
from tests.small import compose

ROOT = Path(__file__).parents[2]
CONF = resources.files("gdrl_torchrl.conf")
REGIMES = {
    "little_data": "ppo_water",
    "one_world": "rainbow_indoor",
    "unstable": "rainbow_indoor",
}
"""Experiments that they are for."""
GROUPS = ("task", "algorithm", "network", "evolution")
SEARCHED = ("algorithm", "network", "evolution")
PARTS = (*GROUPS, "budget", "evaluation", "checkpoint", "logger", "simulation")


def options_of(group):
    return sorted(
        entry.name.removesuffix(".yaml")
        for entry in CONF.joinpath(group).iterdir()
        if entry.name.endswith(".yaml")
    )


EXPERIMENTS = options_of("experiment")


def test_there_is_something_to_test():
    assert {"gppo_water", "ppo_water", "grainbow_indoor"} <= set(EXPERIMENTS)
    assert all(options_of(group) for group in GROUPS)


def assert_is_typed(config):
    assert isinstance(config, schema.ExperimentConfig)
    assert isinstance(config.algorithm, ALGORITHMS[config.algorithm.name])
    assert isinstance(config.task, task_config_class(config.task.name))
    for part in PARTS[2:]:
        assert dataclasses.is_dataclass(getattr(config, part))
    assert make_task_from_config(config.task).name == config.task.name


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_is_named_as_its_file_typed_and_can_be_built(experiment):
    config = load_experiment([f"experiment={experiment}"])
    assert config.name == experiment
    assert_is_typed(config)
    training = build_training(config)
    if training.agent.collector is not None:
        training.agent.collector.shutdown()
    training.close()


@pytest.mark.parametrize(
    ("group", "option"),
    [(group, option) for group in GROUPS for option in options_of(group)],
)
def test_every_file_of_a_group_composes_to_a_typed_configuration(group, option):
    assert_is_typed(load_experiment(["experiment=gppo_water", f"{group}={option}"]))


@pytest.mark.parametrize(
    ("preset", "expected"),
    {
        "water_calm": {
            "goal_distance_m": (2.0, 6.0),
            "goal_tolerance_m": 0.1,
            "sea": "calm",
            "current_m_s": 0.0,
        },
        "water_near": {},
        "water_precise": {"goal_tolerance_m": 0.1},
        "water_linear": {"goal_tolerance_m": 0.1, "dead_zone_compensated": True},
        "water_far_current": {
            "difficulty": "far",
            "goal_distance_m": (5.0, 15.0),
            "goal_tolerance_m": 0.15,
            "sea": "rough",
            "current_m_s": 0.4,
            "progress_weight": 0.0,
        },
        "indoor_paper": {},
        "indoor_sparse": {"arena": "paper", "progress_weight": 0.0},
        "indoor_scatter": {"arena": "scatter", "progress_weight": 10.0},
        "indoor_scatter_sparse": {"arena": "scatter", "progress_weight": 0.0},
        "indoor_corridor": {"arena": "corridor", "step_limit": 1000},
        "indoor_trap": {"arena": "trap", "goal_tolerance_m": 0.05, "step_limit": 500},
    }.items(),
)
def test_a_preset_is_the_task_that_its_name_begins_with(preset, expected):
    name = preset.partition("_")[0]
    task = make_task_from_config(load_experiment([f"task={preset}"]).task)
    assert task.name == name
    assert task.options == make_task(name, **expected).options


def test_a_preset_keeps_the_kind_of_actions_of_an_experiment():
    for experiment, preset in (
        ("rainbow_water", "water_calm"),
        ("ppo_indoor", "indoor_trap"),
    ):
        plain = compose([f"experiment={experiment}"])
        other = load_experiment([f"experiment={experiment}", f"task={preset}"])
        assert other.task.actions == plain.task.actions
        assert other.task != plain.task


@pytest.mark.parametrize("regime", options_of("regime"))
def test_a_regime_changes_its_experiment_and_nothing_else_of_it(regime):
    given = [f"experiment={REGIMES[regime]}"]
    plain, other = compose(given), load_experiment([*given, f"+regime={regime}"])
    assert other.algorithm != plain.algorithm
    assert dataclasses.replace(other, algorithm=plain.algorithm) == plain


def test_the_regimes_are_those_of_their_descriptions():
    little = load_experiment(["experiment=ppo_water", "+regime=little_data"]).algorithm
    sizes = (little.num_worlds, little.frames_per_batch, little.minibatch_size)
    assert sizes == (1, 256, 64)
    fast = load_experiment(["experiment=rainbow_indoor", "+regime=unstable"]).algorithm
    assert (fast.learning_rate, fast.target_tau) == (3e-3, 0.05)


def good_trials(name):
    """Options of trials with a search's largest budget that are within 0.01 of the best."""
    with open(ROOT / "results" / "tuning" / f"{name}_trials.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    largest = max(int(row["total_steps"]) for row in rows)
    last = [row for row in rows if int(row["total_steps"]) == largest]
    best = max(float(row["success_rate"]) for row in last)
    for row in last:
        if float(row["success_rate"]) >= best - 0.01:
            pairs = [option.split("=") for option in row["overrides"].split()]
            yield {name: ast.literal_eval(text) for name, text in pairs}


def with_trial(config, trial):
    """A configuration with the options of a trial."""
    for option, value in trial.items():
        group, field = option.split(".")
        part = dataclasses.replace(getattr(config, group), **{field: value})
        config = dataclasses.replace(config, **{group: part})
    return config


def numbers_in(config):
    return {
        f"{group}.{name}": value
        for group in SEARCHED
        for name, value in dataclasses.asdict(getattr(config, group)).items()
    }


@pytest.mark.parametrize("name", options_of("tuned"))
def test_what_is_tuned_is_one_of_the_best_that_the_search_has_tried(name):
    before = compose(load_search([f"+search={name}"]).overrides)
    tuned = load_experiment([f"experiment={name}", f"+tuned={name}"])
    found = numbers_in(tuned)

    def is_it(trial):
        """But for the digits of its numbers."""
        return all(
            found[option] == (pytest.approx(x, rel=0.05) if type(x) is float else x)
            for option, x in numbers_in(with_trial(before, trial)).items()
        )

    trials = list(good_trials(name))
    assert any(map(is_it, trials)), trials
    # The task that it was searched for on is given beside it.
    rest = {group: getattr(before, group) for group in (*SEARCHED, "task")}
    assert dataclasses.replace(tuned, **rest) == before, "nothing else is changed"


@pytest.mark.parametrize(
    "experiment", ["gppo_water", "grainbow_indoor", "ga_water", "erl_indoor"]
)
def test_an_experiment_of_every_kind_takes_the_common_overrides(experiment):
    overrides = {
        "seed": 3,
        "runs_dir": "elsewhere",
        "force": True,
        "budget.agent_steps": 7,
        "budget.total_steps": 8,
        "budget.wall_s": 7.5,
        "evaluation.episodes": 9,
        "task.step_limit": 77,
        "task.goal_tolerance_m": 0.25,
        "network.actor_cells": [4, 5, 6],
    }
    plain = compose([f"experiment={experiment}"])
    if plain.algorithm.name == "ga":
        overrides["algorithm.mutation_std"] = 0.02
    else:
        overrides["algorithm.learning_rate"] = 0.01
    if isinstance(plain.evolution, EvolutionConfig):
        overrides |= {"evolution.rates": [0.5, 0.2], "evolution.thresholds": [0.5]}
    else:
        overrides["evolution.tournament_size"] = 2
    texts = [f"{name}={value}".replace("'", "") for name, value in overrides.items()]
    config = load_experiment([f"experiment={experiment}", *texts])
    for name, value in overrides.items():
        found = config
        for part in name.split("."):
            found = getattr(found, part)
        assert found == value, name


@pytest.mark.parametrize(
    "override",
    [
        "experiment=gppo_water task.goal_distance_m=[2.5,3.0]",
        "experiment=gppo_water task.extra_observations=[roll,velocity]",
        "experiment=gppo_water task.peak_period_s=2.5",
        "experiment=grainbow_indoor task.turn_rates_deg_s=[-60.0,0.0,60.0]",
        "experiment=grainbow_indoor task.wheel_speed_limit=burger",
        "experiment=grainbow_indoor task.scan_hold=true",
    ],
)
def test_a_tasks_own_options_are_taken(override):
    experiment, option = override.split()
    config = load_experiment([experiment, option])
    default = compose([experiment])
    name = option.partition("=")[0].removeprefix("task.")
    assert getattr(config.task, name) != getattr(default.task, name)
    make_task_from_config(config.task)


# Defaults


@pytest.mark.parametrize("name", task_names())
def test_a_tasks_configuration_has_the_defaults_of_its_options(name):
    config = task_config_class(name)()
    assert make_task_from_config(config).options == make_task(name).options
    composed = load_experiment([f"task={name}"]).task
    assert composed == config


@pytest.mark.parametrize(
    ("group", "default"),
    [
        ("network", schema.NetworkConfig()),
        ("evolution", EvolutionConfig()),
        ("evaluation", schema.EvaluationConfig()),
        ("checkpoint", schema.CheckpointConfig()),
        ("logger", schema.LoggerConfig()),
        ("simulation", schema.SimulationConfig()),
    ],
)
def test_shipped_values_are_the_defaults_of_the_schema(group, default):
    assert getattr(load_experiment([]), group) == default


@pytest.mark.parametrize(
    "experiment", ["ppo_water", "gppo_water", "erl_water", "soft_water"]
)
def test_a_batch_without_a_goal_is_not_scaled_up_on_water(experiment):
    assert not load_experiment([f"experiment={experiment}"]).algorithm.normalize_advantage
    normalised = load_experiment([f"experiment={experiment}", "algorithm=ppo"])
    assert normalised.algorithm.normalize_advantage


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_algorithms_configuration_has_the_defaults_of_its_schema(name):
    assert load_experiment([f"algorithm={name}"]).algorithm == ALGORITHMS[name]()


def defaults_of(function):
    return {
        name: parameter.default
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }


def test_defaults_of_the_schema_are_those_of_the_parts():
    evolution, network = EvolutionConfig(), schema.NetworkConfig()
    parts = (GeneticHook, MutatedChildren, FullContest, HandOver, EpisodeWatch)
    hook = {name: default for part in parts for name, default in defaults_of(part).items()}
    shared = {field.name for field in dataclasses.fields(evolution)} & hook.keys()
    shared -= {"mutation", "crossover", "contest", "success_range"}
    assert len(shared) >= 6
    for name in shared:
        assert getattr(evolution, name) == hook[name], name
    assert tuple(evolution.success_range) == hook["success_range"]
    evaluator = defaults_of(PopulationEvaluator)
    assert evolution.num_trials == evaluator["num_episodes"]
    assert evolution.fitness == evaluator["fitness"]
    schedule = MutationSchedule()
    assert tuple(evolution.rates) == schedule.rates
    assert tuple(evolution.thresholds) == schedule.thresholds
    actor = defaults_of(make_tanh_normal_actor)
    assert tuple(network.actor_cells) == actor["num_cells"]
    assert network.initial_std == actor["initial_std"]
    assert tuple(network.critic_cells) == defaults_of(make_value_network)["num_cells"]
