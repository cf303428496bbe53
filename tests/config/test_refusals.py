"""What a user may get wrong in a configuration is refused by name.

The range of every field is in ``test_ranges.py``; here is what only composing tells.
"""

from __future__ import annotations

import dataclasses

import pytest
from hydra.errors import HydraException

from gdrl_torchrl.cli.shared.compose import load_experiment, merge_task
from gdrl_torchrl.config import schema
from gdrl_torchrl.config.task import make_task_from_config


def refusal(*overrides):
    """What is said about bad overrides, before anything is built."""
    with pytest.raises((ValueError, HydraException)) as refused:
        make_task_from_config(load_experiment(list(overrides)).task)
    return str(refused.value)


@pytest.mark.parametrize(
    "override",
    [
        # One of each kind: a number too small, too large, not finite, not whole, a word
        # in place of one; a word that is none of the choices; and those of the task.
        "algorithm.num_worlds=0",
        "algorithm.gamma=1.01",
        "budget.wall_s=nan",
        "task.substep_s=inf",
        "evaluation.episodes=2.5",
        "checkpoint.keep=many",
        "logger.tensorboard=maybe",
        "network.activation=sailing",
        "task.backend=sailing",
        "task.sea=sailing",
        "task.step_limit=0",
        "evolution.num_worlds=0",
        "experiment=grainbow_indoor task.num_beams=0",
        # Lists: their length, their elements, their order.
        "network.actor_cells=[]",
        "network.critic_cells=[8,0]",
        "evolution.rates=[0.5,0.2,1.5]",
        "evolution.rates=[0.5]",
        "evolution.thresholds=[0.8,0.4]",
        "evolution.thresholds=[0.4,nan]",
        "task.goal_distance_m=[3.0,2.0]",
        "task.goal_distance_m=[3.0]",
        "task.extra_observations=[fuel]",
        "experiment=grainbow_indoor task.turn_rates_deg_s=[0.0]",
        "experiment=grainbow_indoor task.turn_rates_deg_s=[0.0,200.0]",
        # What other fields allow.
        "budget.agent_steps=null",
        "task.substep_s=0.07",
        "task.goal_tolerance_m=2.5",
    ],
)
def test_bad_values_are_named(override):
    *base, override = override.split()
    name, value = override.split("=")
    said = refusal(*base, override)
    assert name.rpartition(".")[2] in said
    pieces = value.strip("[]").split(",")
    assert value == "null" or any(piece in said for piece in pieces)


@pytest.mark.parametrize("part", ["", "task.", "algorithm.", "evolution.", "budget."])
def test_unknown_keys_are_named(part):
    said = refusal(f"{part}fuel=1")
    assert f"{part}fuel" in said


@pytest.mark.parametrize(
    "choice", ["task.name=moon", "algorithm.name=sail", "task=moon", "evolution=lamarck"]
)
def test_unknown_files_are_named(choice):
    said = refusal(choice)
    assert choice.partition("=")[2] in said


@pytest.mark.parametrize("name", ["", "a/b", "..", "."])
def test_a_run_is_named_as_a_folder_can_be(name):
    with pytest.raises(ValueError, match="name="):
        schema.ExperimentConfig(name=name)


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
