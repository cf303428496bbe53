"""What must hold between fields: it is refused with the names of both."""

from __future__ import annotations

import dataclasses
import re

import pytest

from gdrl_torchrl.agents.settings import NetworkConfig
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.runs.build import build_training
from tests.config.fields import REFUSAL

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
