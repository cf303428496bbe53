"""What a row of the table says of success rates, and of which runs it is made."""

from __future__ import annotations

import dataclasses
import json
import shlex
import statistics

import pytest

from benchmarks.presets.bare_agents import rows_of_runs
from benchmarks.presets.known import PRESETS
from benchmarks.presets.table import (
    CRITERIA,
    certified,
    interval,
    make_row,
    read_table,
    update_table,
)
from gdrl_torchrl.cli.shared.compose import load_experiment


def row_of(criterion, rates, *, preset="water_calm", episodes=200):
    return make_row(
        preset,
        criterion,
        rates,
        seeds=range(len(rates)),
        episodes=episodes,
        total_steps=None,
        settings="task=water_calm",
        commit="1a2b3c4",
    )


def test_an_interval_of_one_controller_is_the_exact_binomial_one():
    # Of 10 successes in 10 the lower end is the tenth root of 0.025.
    low, high = interval("scripted", [1.0], 10)
    assert (low, high) == pytest.approx((0.025**0.1, 1.0))


def test_no_success_at_all_leaves_room_for_rare_ones():
    low, high = interval("untrained_greedy", [0.0] * 10, 200)
    assert (low, high) == pytest.approx((0.0, 1.0 - 0.025 ** (1 / 2000)))


def test_seeds_that_differ_widen_an_interval_beyond_the_binomial_one():
    low, high = interval("bare_agent_mean", [0.0, 1.0] * 5, 500)
    # Ten coins: 2 to 8 of 10 hold 95 %.
    assert 0.15 <= low <= 0.25
    assert 0.75 <= high <= 0.85


@pytest.mark.parametrize(
    ("criterion", "rates", "verdict"),
    [
        ("scripted", [0.9], "pass"),
        ("scripted", [0.895], "fail"),
        ("untrained_greedy", [0.0, 0.04], "pass"),
        ("untrained_sampled", [0.0, 0.05], "fail"),
        ("bare_agent_mean", [0.1, 0.1], "pass"),
        ("bare_agent_mean", [0.9, 0.6], "fail"),
        ("bare_agent_mean", [0.0, 0.1], "fail"),
        ("bare_agent_mean", [float("nan"), 0.4], "fail"),
        ("bare_agent_sd", [0.4, 0.6], "pass"),
        ("bare_agent_sd", [0.4, 0.5], "fail"),
    ],
)
def test_a_figure_outside_of_its_range_fails(criterion, rates, verdict):
    assert row_of(criterion, rates).verdict == verdict


def test_a_preset_is_certified_by_all_criteria_only(tmp_path):
    good = {name: [0.3, 0.6] for name in CRITERIA}
    good |= {"scripted": [1.0], "untrained_greedy": [0.0], "untrained_sampled": [0.0]}
    rows = [row_of(name, rates) for name, rates in good.items()]
    assert certified(rows) == {"water_calm": "certified"}
    assert certified(rows[:4]) == {"water_calm": "not measured in full"}
    spoilt = [*rows[:4], row_of("bare_agent_sd", [0.3, 0.3])]
    assert certified(spoilt) == {"water_calm": "failed"}


def test_what_is_measured_again_takes_the_place_of_what_was(tmp_path):
    path = tmp_path / "below" / "certified.csv"
    old = [row_of("scripted", [0.5]), row_of("scripted", [0.95], preset="indoor_trap")]
    update_table(old, path)
    new = row_of("scripted", [1.0])
    assert update_table([new], path) == read_table(path) == [old[1], new]


@pytest.mark.parametrize("preset", PRESETS.values(), ids=lambda preset: preset.name)
def test_a_command_trains_a_bare_agent_where_its_runs_are_looked_for(preset):
    command, many, *overrides, seeds = shlex.split(preset.command(4))
    config = load_experiment(overrides)
    assert (command, many, seeds) == ("gdrl-train", "-m", "seed=range(200,204)")
    assert not config.evolution.enabled
    assert config.name == f"certify_{preset.name}"
    assert config.budget.agent_steps is None
    assert config.budget.total_steps == preset.total_steps


# Runs


@pytest.fixture
def trained(tmp_path):
    """Makes finished runs of a preset with given success rates, as files."""
    preset = PRESETS["indoor_trap"]

    def make(rates, *overrides, name=f"certify_{preset.name}"):
        for seed, rate in rates.items():
            given = [*preset.overrides, "budget.total_steps=9", f"seed={seed}", *overrides]
            given += ["name=x", "runs_dir=elsewhere", "logger.tensorboard=false"]
            config = load_experiment(given)
            folder = tmp_path / name / "1a2b3c4d" / f"seed_{seed}"
            folder.mkdir(parents=True)
            files = {
                "config.json": dataclasses.asdict(config),
                "overrides.json": {"overrides": given},
                "evaluation.json": {
                    "task": "indoor",
                    "algorithm": "rainbow",
                    "seed": seed,
                    "episodes": 500,
                    "success_rate": rate,
                    "agent_steps": 9,
                    "total_steps": 9,
                    "wall_s": 1.0,
                },
            }
            for file, content in files.items():
                (folder / file).write_text(json.dumps(content))
            (folder / "DONE").touch()
        return tmp_path

    return make


def test_runs_become_a_mean_and_a_deviation_over_seeds(trained):
    rates = {3: 0.1, 1: 0.7, 2: 0.4}
    mean, deviation = rows_of_runs(PRESETS["indoor_trap"], trained(rates), "abc")
    assert float(mean.figure) == pytest.approx(statistics.mean(rates.values()), abs=1e-4)
    assert float(deviation.figure) == pytest.approx(
        statistics.stdev(rates.values()), abs=1e-4
    )
    assert (mean.seeds, mean.success) == ("1 2 3", "0.7000 0.4000 0.1000")
    assert (mean.episodes, mean.total_steps) == ("500", "9")
    assert mean.settings == (
        "experiment=rainbow_indoor +tuned=rainbow_indoor task=indoor_trap "
        "budget.total_steps=9"
    )
    assert rows_of_runs(PRESETS["water_near"], trained({}), "abc") == []


def test_runs_that_do_not_belong_together_are_refused_by_name(trained):
    preset = PRESETS["indoor_trap"]
    folder = trained({0: 0.3})
    with pytest.raises(ValueError, match=r"seed_0 must not be the only run"):
        rows_of_runs(preset, folder, "abc")
    trained({1: 0.5}, "algorithm.learning_rate=0.01")
    with pytest.raises(
        ValueError, match=r"seed_1 and .*seed_0 must have the same algorithm"
    ):
        rows_of_runs(preset, folder, "abc")


@pytest.mark.parametrize("other", ["task.speed_m_s=0.1", "evolution=genetic"])
def test_runs_of_another_task_or_with_a_population_are_refused(trained, other):
    folder = trained({0: 0.3, 1: 0.5}, other)
    with pytest.raises(ValueError, match=r"seed_0 must be of the bare agent on preset=ind"):
        rows_of_runs(PRESETS["indoor_trap"], folder, "abc")


def test_runs_that_are_not_finished_are_refused(trained):
    folder = trained({0: 0.3, 1: 0.5})
    next(folder.rglob("seed_1/DONE")).unlink()
    with pytest.raises(ValueError, match=r"seed_1 must be done: it is stopped"):
        rows_of_runs(PRESETS["indoor_trap"], folder, "abc")
