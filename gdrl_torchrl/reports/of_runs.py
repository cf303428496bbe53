"""Evidence from run directories, whatever they are."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gdrl_torchrl.files.evaluation import read_evaluation
from gdrl_torchrl.files.fields import TEXT, read_object
from gdrl_torchrl.files.metrics import read_metrics
from gdrl_torchrl.files.run_table import find_runs, run_row
from gdrl_torchrl.reports.evidence import Arm, Evidence, Run, Words

_WORDS = Words(
    score="greedy success over held-out worlds at a run's end",
    score_name="held-out success",
    curve="success while training",
)
_OF_EVALUATION = {
    "success_rate": "success_rate",
    "success_rate_sampled": "success_rate_sampled",
    "return_mean": "return_mean",
    "steps_mean": "episode_steps",
    "time_s_mean": "episode_s",
    "speed_m_s_mean": "speed_m_s",
    "agent_steps": "agent_steps",
    "population_steps": "population_steps",
    "total_steps": "total_steps",
    "wall_s": "wall_s",
}
"""Names of ours by those in ``evaluation.json``."""
_OF_METRICS = {
    "episodes": "agent_episodes",
    "total_steps": "total_steps",
    "wall_s": "wall_s",
    "success_rate": "success_rate",
}
"""Names of a curve's columns by those in ``metrics.csv``."""
_MOST_POINTS = 200
"""Of a curve: more are not seen, and make the page large."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Found:
    """A run that ended or failed, with what it is told apart by."""

    task: str
    names: tuple[str, str, str]
    run: Run


def runs_evidence(folder: str | Path) -> Evidence:
    """Evidence from all runs below a folder, by task, algorithm, name and configuration.

    Runs that ended count with their held-out success, those that failed as 0; runs that go
    on, can go on or are damaged are left out, and it is said how many.

    Args:
        folder: The folder.

    Raises:
        ValueError: If there is no such folder, or no run in it has ended.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"runs={folder} must be a folder with runs below it")
    rows = {run: run_row(run) for run in find_runs(folder)}
    found, remarks = [], []
    for run, row in rows.items():
        if row["state"] in ("done", "failed"):
            try:
                found.append(_found(run, row, folder))
            except (OSError, ValueError) as error:
                remarks.append(f"Left out: {error}")
        elif row["state"] == "damaged":
            remarks.append(f"Left out: {row['damage']}")
    states = Counter(row["state"] for row in rows.values())
    remarks += [
        f"Left out, runs that {what}: {states[state]}."
        for state, what in (("running", "go on"), ("stopped", "were interrupted"))
        if states[state]
    ]
    if not found:
        raise ValueError(f"runs={folder} must have a run below it that has ended")
    found, twins = _without_twins(found)
    if twins:
        remarks.append(f"Left out, copies of other runs here: {twins}.")
    return Evidence(
        title=f"Runs of {folder.resolve().name}",
        question="",
        words=_WORDS,
        facts=(
            ("runs that ended", str(states["done"])),
            ("runs that failed", str(states["failed"])),
            ("code", ", ".join(sorted({_code(run) for run in rows}))),
        ),
        remarks=tuple(remark.replace(f"{folder}/", "") for remark in remarks),
        sources=(f"gdrl-report runs={folder.name}",),
        arms=_arms(found),
    )


def _found(run: Path, row: Mapping[str, Any], folder: Path) -> _Found:
    failed = row["state"] == "failed"
    numbers = {"success_rate": 0.0, "success_rate_sampled": 0.0}
    curve: dict[str, np.ndarray] = {}
    if not failed:
        metrics = read_metrics(run)
        numbers = _numbers(read_evaluation(run)) | _last(metrics)
        curve = _curve(metrics)
    origin = f"{run.relative_to(folder)}, code {_code(run)}"
    return _Found(
        row["task"],
        (row["algorithm"], row["name"], run.parent.name),
        Run(row["seed"], origin, failed, numbers["success_rate"], numbers, curve),
    )


def _numbers(evaluation: Mapping[str, Any]) -> dict[str, float]:
    known = {ours: evaluation.get(name) for name, ours in _OF_EVALUATION.items()}
    return {name: float(value) for name, value in known.items() if value is not None}


def _last(metrics: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Counts at the end of training."""
    names = {"episodes": "agent_episodes", "evaluations": "evaluations"}
    names |= {"switches": "switches"}
    return {
        ours: float(metrics[name][-1])
        for name, ours in names.items()
        if name in metrics and len(metrics[name]) and np.isfinite(metrics[name][-1])
    }


def _curve(metrics: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    rows = np.flatnonzero(np.isfinite(metrics.get("success_rate", np.empty(0))))
    if len(rows) > _MOST_POINTS:
        rows = rows[np.linspace(0, len(rows) - 1, _MOST_POINTS).astype(int)]
    return {
        ours: metrics[name][rows] for name, ours in _OF_METRICS.items() if name in metrics
    }


def _code(run: Path) -> str:
    try:
        return read_object(run / "provenance.json", {"code": TEXT})["code"]
    except (OSError, ValueError):
        return "unknown"


def _without_twins(found: Iterable[_Found]) -> tuple[list[_Found], int]:
    """Copies of a run are no further evidence: one of each, and how many there were."""
    first: dict[Any, _Found] = {}
    everything = list(found)
    for one in everything:
        first.setdefault((one.task, one.names, one.run.seed), one)
    return list(first.values()), len(everything) - len(first)


def _arms(found: list[_Found]) -> tuple[Arm, ...]:
    """Arms named by algorithm; by name and configuration too, where that is needed."""
    groups: dict[tuple[str, tuple[str, str, str]], list[Run]] = {}
    for one in found:
        groups.setdefault((one.task, one.names), []).append(one.run)
    arms = []
    for (task, names), runs in groups.items():
        by_seed = sorted(runs, key=lambda run: run.seed)
        arms.append(Arm(task, _method(names, groups), tuple(by_seed)))
    return tuple(sorted(arms, key=lambda arm: (arm.task, arm.method)))


def _method(
    names: tuple[str, str, str], groups: Iterable[tuple[str, tuple[str, str, str]]]
) -> str:
    """As few of algorithm, name and configuration as tell the methods of any task apart."""
    for depth in (1, 2, 3):
        alike = [(t, other) for t, other in groups if other[:depth] == names[:depth]]
        if len({t for t, _ in alike}) == len(alike):
            return " ".join(names[:depth])
    return " ".join(names)
