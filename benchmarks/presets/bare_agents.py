"""Success of bare agents over seeds, from their run directories."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from benchmarks.presets.known import Preset
from benchmarks.presets.table import Row, make_row
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.files.evaluation import CONFIG_FILE, read_evaluation
from gdrl_torchrl.files.fields import OBJECT, SWITCH, read_object
from gdrl_torchrl.files.run_table import find_runs, state_of

_CONFIG = {
    "task": OBJECT,
    "algorithm": OBJECT,
    "network": OBJECT,
    "budget": OBJECT,
    "evaluation": OBJECT,
    "evolution.enabled": SWITCH,
}
_SHARED = ("algorithm", "network", "budget", "evaluation")


def rows_of_runs(preset: Preset, folder: Path, commit: str) -> list[Row]:
    """Mean and deviation over the finished runs below ``folder/certify_<preset>``.

    Args:
        preset: The preset.
        folder: The ``runs_dir`` of the runs.
        commit: Version of the code.

    Returns:
        Two rows; none if there are no runs.

    Raises:
        ValueError: If a run is not finished or not of the preset's bare agent, if the runs
            differ in more than their seeds, or if there is only one.
    """
    place = folder / f"certify_{preset.name}"
    runs = find_runs(place) if place.is_dir() else []
    if not runs:
        return []
    results, first = {}, {}
    task = dataclasses.asdict(load_experiment(preset.overrides).task)
    for run in runs:
        config = read_object(run / CONFIG_FILE, _CONFIG)
        if (state := state_of(run)) != "done":
            raise ValueError(f"{run} must be done: it is {state}")
        if config["task"] != task or config["evolution"]["enabled"]:
            raise ValueError(f"{run} must be of the bare agent on preset={preset.name}")
        first = first or config
        for name in _SHARED:
            if config[name] != first[name]:
                raise ValueError(f"{run} and {runs[0]} must have the same {name}")
        result = read_evaluation(run)
        results[result["seed"]] = result["success_rate"]
    if len(results) < 2:
        raise ValueError(f"{runs[0]} must not be the only run: a deviation needs two seeds")
    seeds = sorted(results)
    rates = [results[seed] for seed in seeds]
    known: dict[str, Any] = {
        "seeds": seeds,
        "episodes": first["evaluation"]["episodes"],
        "total_steps": first["budget"]["total_steps"],
        "settings": _settings(runs[0]),
        "commit": commit,
    }
    criteria = ("bare_agent_mean", "bare_agent_sd")
    return [make_row(preset.name, criterion, rates, **known) for criterion in criteria]


def _settings(run: Path) -> str:
    """What was given on the command line, but for what changes no result."""
    given = read_object(run / "overrides.json", {})["overrides"]
    apart = ("seed=", "runs_dir=", "name=", "logger.", "simulation.")
    return " ".join(text for text in given if not text.startswith(apart))
