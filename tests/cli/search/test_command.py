"""The command gdrl-search: what is shipped, what it refuses, what it prints."""

from __future__ import annotations

import dataclasses
import json
import shlex
import subprocess
import sysconfig
from importlib import resources
from pathlib import Path

import pytest

from gdrl_torchrl.cli.search import load_search
from gdrl_torchrl.cli.shared.compose import load_experiment
from tests.cli.search.fake_runs import search_of
from tests.marks import full_but

SCRIPTS = Path(sysconfig.get_path("scripts"))
SEARCHES = sorted(
    entry.name.removesuffix(".yaml")
    for entry in resources.files("gdrl_torchrl.conf").joinpath("search").iterdir()
)


@pytest.mark.parametrize("name", full_but(["grainbow_indoor", "ppo_water"], SEARCHES))
def test_every_search_can_run_its_first_and_last_values(name):
    search = load_search([f"+search={name}"])
    assert search.name == f"search_{name}"
    assert search.overrides
    for end in (0, -1):
        chosen = []
        for param, choices in search.params.items():
            values = choices.rpartition("(")[2].strip(")").split(",")
            chosen.append(f"{param}={values[end].strip()}")
        load_experiment([*search.overrides, *chosen])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "must be given once"),
        (["+search=nothing"], r"\+search=nothing must be one of"),
        (["search=gpo_water"], r"did you mean \+search=gppo_water"),
        (["+search=gppo_water", "+search.fuel=1"], r"\+search.fuel=1 must be an option"),
        (["+search=gppo_water", "search.num_trials=1e1"], "write 10"),
        (["+search=gppo_water", "search.seeds=["], "must be name=value"),
        (["+search=gppo_water", "search.num_trials=0"], "num_trials=0"),
        (["+search=gppo_water", "search.storage=redis"], "storage='redis'"),
        (["+search=gppo_water", "search.total_steps=[2,1]"], "ascending"),
        (["+search=gppo_water", "search.params=null"], "params"),
        (["+search=gppo_water", "search.unknown=1"], "search.unknown=1 must be an option"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        load_search(arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"params": {"evolution.mut_v": "0.1"}}, "nothing to choose from"),
        ({"params": {"evolution.mut_v": "choice("}}, "must be name=value"),
        ({"overrides": ["experiment=nothing"]}, "nothing"),
        ({"overrides": ["toy=true"]}, "toy=true"),
    ],
)
def test_a_search_that_cannot_work_is_refused_before_its_first_trial(
    tmp_path, options, message
):
    with pytest.raises(Exception, match=message):
        search_of(tmp_path, **options)


@pytest.mark.full
def test_the_command_trains_and_prints_the_best_overrides_last(tmp_path):
    command = [
        SCRIPTS / "gdrl-search",
        "+search=gppo_water",
        "search.num_trials=2",
        "search.total_steps=[1000,5000]",
        "search.episodes=2",
        "search.seeds=[0]",
        "task.step_limit=60",
        "network.actor_cells=[16, 16]",
        "algorithm.frames_per_batch=512",
        "algorithm.num_epochs=1",
        f"runs_dir={tmp_path}",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    *table, best = done.stdout.strip().splitlines()
    assert len(table) == 2
    assert best.startswith("gdrl-train experiment=gppo_water ")
    assert " task.step_limit=60 " in best
    # As a shell takes it.
    found = load_experiment(shlex.split(best)[1:])
    assert found.network.actor_cells == [16, 16]
    evaluations = list(tmp_path.rglob("evaluation.json"))
    assert len(evaluations) == 2
    records = [json.loads(path.read_text()) for path in evaluations]
    assert all(record["total_steps"] >= 5000 for record in records)
    configs = [
        json.loads((path.parent / "config.json").read_text()) for path in evaluations
    ]
    assert dataclasses.asdict(found.evolution) in [c["evolution"] for c in configs]
