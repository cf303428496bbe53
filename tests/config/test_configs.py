"""Every shipped configuration works; every bad one is refused by name."""

from __future__ import annotations

import dataclasses
import inspect
from importlib import resources

import pytest
from hydra.errors import HydraException

from gdrl_tasks import make_task, task_names
from gdrl_torchrl.agents.networks import make_tanh_normal_actor, make_value_network
from gdrl_torchrl.agents.registry import ALGORITHMS
from gdrl_torchrl.cli.shared.compose import load_experiment, merge_task
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

CONF = resources.files("gdrl_torchrl.conf")
GROUPS = ("task", "algorithm", "network", "evolution")
PARTS = (*GROUPS, "budget", "evaluation", "checkpoint", "logger", "simulation")


def options_of(group):
    return sorted(
        entry.name.removesuffix(".yaml")
        for entry in CONF.joinpath(group).iterdir()
        if entry.name.endswith(".yaml")
    )


EXPERIMENTS = options_of("experiment")


BASES = ("gppo_water", "grainbow_indoor")
"""An experiment of every task and algorithm."""


def fields(base):
    """Every field of a configuration: its dotted name, its type, its value."""
    config = load_experiment([f"experiment={base}"])
    for name in ("seed",):
        yield name, "int", getattr(config, name)
    for part in PARTS:
        for field in dataclasses.fields(getattr(config, part)):
            kind = field.type if isinstance(field.type, str) else str(field.type)
            yield f"{part}.{field.name}", kind, getattr(getattr(config, part), field.name)


def is_number(kind):
    return not any(word in kind for word in ("list", "str", "bool", "Any"))


FIELDS = {
    (base, name): (kind, value) for base in BASES for name, kind, value in fields(base)
}
NUMBERS = [
    (base, name)
    for (base, name), (kind, _) in FIELDS.items()
    if is_number(kind) and (base == BASES[0] or name.startswith(("task.", "algorithm.")))
]
REALS = [key for key in NUMBERS if "float" in FIELDS[key][0]]
WHOLE = sorted(set(NUMBERS) - set(REALS))
WORDS = [
    (base, name)
    for (base, name), (_, value) in FIELDS.items()
    if isinstance(value, str) and not name.endswith(".name")
]


def compose_and_make_task(overrides):
    make_task_from_config(load_experiment(overrides).task)


def refusal(*overrides):
    """What is said about bad overrides, before anything is built."""
    with pytest.raises((ValueError, HydraException)) as refused:
        compose_and_make_task(list(overrides))
    return str(refused.value)


# What is shipped


def test_there_is_something_to_test():
    assert {"gppo_water", "ppo_water", "grainbow_indoor"} <= set(EXPERIMENTS)
    assert all(options_of(group) for group in GROUPS)
    assert len(NUMBERS) > 50
    assert len(REALS) > 30
    assert len(WORDS) > 16
    assert {load_experiment([f"experiment={base}"]).task.name for base in BASES} == set(
        task_names()
    )


@pytest.mark.parametrize(
    ("experiment", "choice"),
    [
        *((experiment, "seed=0") for experiment in EXPERIMENTS),
        *(
            (base, f"{group}={option}")
            for base in BASES
            for group in GROUPS
            for option in options_of(group)
        ),
    ],
)
def test_every_shipped_file_composes_to_a_typed_configuration(experiment, choice):
    config = load_experiment([f"experiment={experiment}", choice])
    assert isinstance(config, schema.ExperimentConfig)
    assert isinstance(config.algorithm, ALGORITHMS[config.algorithm.name])
    assert isinstance(config.task, task_config_class(config.task.name))
    for part in PARTS[2:]:
        assert dataclasses.is_dataclass(getattr(config, part))
    assert make_task_from_config(config.task).name == config.task.name


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_can_be_built(experiment):
    training = build_training(load_experiment([f"experiment={experiment}"]))
    if training.agent.collector is not None:
        training.agent.collector.shutdown()
    training.close()


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_is_named_as_its_file(experiment):
    assert load_experiment([f"experiment={experiment}"]).name == experiment


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_takes_the_common_overrides(experiment):
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
    plain = load_experiment([f"experiment={experiment}"])
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
    default = load_experiment([experiment])
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
    shared -= {"mutation", "crossover", "contest", "sensitivity"}
    assert len(shared) >= 6
    for name in shared:
        assert getattr(evolution, name) == hook[name], name
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


# What is refused


@pytest.mark.parametrize(("base", "name"), NUMBERS)
def test_no_number_is_negative(base, name):
    said = refusal(f"experiment={base}", f"{name}=-250")
    assert name.rpartition(".")[2] in said
    assert "-250" in said


@pytest.mark.parametrize(("base", "name"), REALS)
@pytest.mark.parametrize("value", ["nan", "inf"])
def test_every_number_is_finite(base, name, value):
    said = refusal(f"experiment={base}", f"{name}={value}")
    assert name.rpartition(".")[2] in said
    assert value in said


@pytest.mark.parametrize(("base", "name"), WHOLE)
def test_counts_are_whole(base, name):
    said = refusal(f"experiment={base}", f"{name}=2.5")
    assert name in said
    assert "2.5" in said


@pytest.mark.parametrize(("base", "name"), NUMBERS[::5])
def test_numbers_are_not_words(base, name):
    said = refusal(f"experiment={base}", f"{name}=many")
    assert name in said
    assert "many" in said


@pytest.mark.parametrize(("base", "name"), WORDS)
def test_words_are_among_the_choices(base, name):
    said = refusal(f"experiment={base}", f"{name}=sailing")
    assert name.rpartition(".")[2] in said
    assert "sailing" in said


@pytest.mark.parametrize(
    "override",
    [
        "algorithm.num_worlds=0",
        "algorithm.minibatch_size=0",
        "algorithm.num_epochs=0",
        "algorithm.learning_rate=0",
        "algorithm.clip_epsilon=0",
        "algorithm.max_grad_norm=0",
        "algorithm.gamma=1.01",
        "algorithm.lmbda=1.01",
        "network.initial_std=0",
        "network.actor_cells=[]",
        "network.critic_cells=[8,0]",
        "evolution.num_children=0",
        "evolution.num_trials=0",
        "evolution.period_episodes=0",
        "evolution.window_episodes=0",
        "evolution.num_worlds=0",
        "evolution.rates=[0.5,0.2,1.5]",
        "evolution.rates=[0.5,0.2,-0.5]",
        "evolution.rates=[0.5]",
        "evolution.thresholds=[0.8,0.4]",
        "evolution.thresholds=[0.4,nan]",
        "budget.agent_steps=0",
        "budget.total_steps=0",
        "budget.wall_s=0",
        "budget.agent_steps=null",
        "evaluation.episodes=0",
        "evaluation.num_worlds=0",
        "checkpoint.keep=0",
        "task.step_limit=0",
        "task.substep_s=0.07",
        "task.goal_distance_m=[3.0,2.0]",
        "task.goal_distance_m=[3.0]",
        "task.goal_tolerance_m=2.5",
        "task.extra_observations=[fuel]",
        "task.actions=continuousdiscrete",
        *(
            f"experiment=grainbow_indoor {override}"
            for override in (
                "algorithm.num_steps=0",
                "algorithm.num_atoms=1",
                "algorithm.target_tau=0",
                "algorithm.target_tau=1.5",
                "algorithm.epsilon_decay=1.5",
                "algorithm.exploration=boltzmann",
                "algorithm.noisy_std=0",
                "algorithm.replay_capacity=0",
                "evolution.target_tau=1.5",
                "evolution.experience_share=1.5",
                "task.turn_rates_deg_s=[0.0]",
                "task.turn_rates_deg_s=[0.0,200.0]",
                "task.field_of_view_deg=400",
                "task.num_beams=0",
                "task.wheel_speed_limit=waffle",
                "task.arena=maze",
            )
        ),
    ],
)
def test_values_out_of_range_are_named(override):
    *base, override = override.split()
    name, value = override.split("=")
    said = refusal(*base, override)
    assert name.rpartition(".")[2] in said
    pieces = value.strip("[]").split(",")
    assert value == "null" or any(piece in said for piece in pieces)


def test_sizes_that_do_not_fit_are_named_together():
    said = refusal("algorithm.num_worlds=7")
    assert "algorithm.num_worlds=7" in said
    assert "algorithm.frames_per_batch=2048" in said
    said = refusal("algorithm.minibatch_size=4096")
    assert "algorithm.minibatch_size=4096" in said
    rainbow = "experiment=grainbow_indoor"
    said = refusal(rainbow, "algorithm.warmup_steps=300", "algorithm.replay_capacity=200")
    assert "algorithm.warmup_steps=300" in said
    assert "algorithm.replay_capacity=200" in said
    said = refusal(rainbow, "algorithm.epsilon_end=0.5", "algorithm.epsilon_start=0.2")
    assert "algorithm.epsilon_end=0.5" in said
    assert "algorithm.epsilon_start=0.2" in said


@pytest.mark.parametrize("part", ["", *(f"{part}." for part in PARTS)])
def test_unknown_keys_are_named(part):
    said = refusal(f"{part}fuel=1")
    assert f"{part}fuel" in said


@pytest.mark.parametrize(
    "choice",
    [
        "task.name=moon",
        "algorithm.name=sail",
        "experiment=gppo_moon",
        "task=moon",
        "algorithm=sail",
        "evolution=lamarck",
    ],
)
def test_unknown_files_are_named(choice):
    said = refusal(choice)
    assert choice.partition("=")[2] in said


@pytest.mark.parametrize("name", ["", "a/b", "..", "."])
def test_a_run_is_named_as_a_folder_can_be(name):
    with pytest.raises(ValueError, match="name="):
        schema.ExperimentConfig(name=name)


# Overrides of a saved task


def test_a_saved_task_takes_overrides():
    saved = dataclasses.asdict(load_experiment([]).task)
    merged = merge_task(saved, ["sea=rough", "step_limit=50"])
    assert (merged.sea, merged.step_limit) == ("rough", 50)
    assert dataclasses.asdict(merged) == saved | {"sea": "rough", "step_limit": 50}


@pytest.mark.parametrize("override", ["fuel=1", "step_limit=many"])
def test_a_bad_override_of_a_saved_task_is_named(override):
    saved = dataclasses.asdict(load_experiment([]).task)
    with pytest.raises(ValueError, match=r"task\..* must ") as refused:
        merge_task(saved, [override])
    assert override.partition("=")[0] in str(refused.value)
