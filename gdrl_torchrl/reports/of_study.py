"""Evidence from the results of a study."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gdrl_torchrl.reports.evidence import Arm, Evidence, Hypothesis, Run, Words
from gdrl_torchrl.studies.results import StudyResults

_WORDS = {
    "area": Words(
        score="the area under held-out greedy success over total steps (mean over the "
        "policies kept along a run)",
        score_name="area",
        curve="held-out success",
    ),
    "success_rate": Words(
        score="greedy success over held-out worlds at a run's end",
        score_name="success_rate",
        curve="held-out success",
    ),
}
"""By the metric of the protocol."""
_NUMBERS = (
    "success_rate",
    "success_rate_sampled",
    "area_sampled",
    "return_mean",
    "episode_steps",
    "episode_s",
    "speed_m_s",
    "agent_steps",
    "population_steps",
    "total_steps",
    "agent_episodes",
    "wall_s",
    "evaluations",
    "switches",
)
_CURVE = ("total_steps", "agent_episodes", "wall_s", "success_rate")
Key = tuple[str, str, int]
"""Task, method and seed of a run."""


def read_study(folder: Path) -> Evidence:
    """Evidence from the folder of a study's results.

    Raises:
        ValueError: If there is none, or a file in it was changed or is damaged.
    """
    results = StudyResults(folder)
    try:
        protocol, digest = results.protocol()
    except FileNotFoundError as error:
        raise ValueError(
            f"study={folder.name} must be a study with results: there is no "
            f"{folder / 'protocol.json'}"
        ) from error
    return study_evidence(
        *(folder, digest, protocol),
        *(results.runs(), results.curves(), results.elsewhere()),
    )


def study_evidence(
    folder: Path,
    digest: str,
    protocol: Mapping[str, Any],
    runs: Iterable[Mapping[str, Any]],
    points: Iterable[Mapping[str, Any]],
    elsewhere: Iterable[Mapping[str, Any]] = (),
) -> Evidence:
    """Evidence from what a study has written.

    Args:
        folder: Of the study's results; the hashes of its files are noted.
        digest: Of the protocol.
        protocol: What was fixed before the runs.
        runs: Rows of ``runs.csv``: one a run.
        points: Rows of ``curves.csv``: one for each policy that a run has kept.
        elsewhere: Rows of ``elsewhere.csv``: one for each run and kind of other worlds.
    """
    planned = [
        (task, method, seed)
        for task, method in _pairs(protocol)
        for seed in protocol["seeds"]
    ]
    of_all = list(runs)
    rows = {_key(row): row for row in of_all if row["protocol"] == digest[:12]}
    curves: dict[Key, list[Mapping[str, Any]]] = {}
    for point in points:
        curves.setdefault(_key(point), []).append(point)
    others: dict[Key, dict[str, float]] = {}
    for row in elsewhere:
        others.setdefault(_key(row), {})[row["worlds"]] = _number(row["success_rate"])
    labels = _labels(protocol)
    arms = []
    for task, method in _pairs(protocol):
        keys = [key for key in planned if key[:2] == (task, method)]
        done = tuple(
            _run(
                *(rows[key], curves.get(key, []), others.get(key, {})),
                protocol["metric"],
            )
            for key in keys
            if key in rows
        )
        missing = tuple(key[2] for key in keys if key not in rows)
        made = {str(rows[key]["configuration"]) for key in keys if key in rows}
        arms.append(Arm(task, labels[method], done, missing, tuple(sorted(made - {""}))))
    known = [rows[key] for key in planned if key in rows]
    return Evidence(
        title=f"Study {protocol['name']}",
        question=protocol["question"],
        words=_WORDS[protocol["metric"]],
        facts=tuple(_facts(digest, protocol, known)),
        remarks=tuple(_remarks(planned, rows, len(of_all) - len(rows))),
        sources=tuple(_sources(folder, digest, protocol)),
        arms=tuple(arms),
        hypotheses=tuple(_hypotheses(protocol, labels)),
        alpha=protocol["alpha"],
        baselines={t: labels[m] for t, m in protocol.get("baseline", {}).items()},
    )


def _pairs(protocol: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Every task with each of its methods."""
    return [
        (task, name)
        for task in protocol["tasks"]
        for name, method in protocol["methods"].items()
        if task in method["tasks"]
    ]


def _labels(protocol: Mapping[str, Any]) -> dict[str, str]:
    """What methods are called; their names where two labels are equal."""
    methods = protocol["methods"]
    labels = {name: method.get("label") or name for name, method in methods.items()}
    return labels if len(set(labels.values())) == len(labels) else {n: n for n in labels}


def _key(row: Mapping[str, Any]) -> Key:
    return row["task"], row["method"], int(row["seed"])


def _run(
    row: Mapping[str, Any],
    points: Sequence[Mapping[str, Any]],
    elsewhere: Mapping[str, float],
    metric: str,
) -> Run:
    failed = row["state"] == "failed"
    # What a run that failed had cost says nothing of what one costs.
    names = ("success_rate", "success_rate_sampled") if failed else _NUMBERS
    numbers = {name: 0.0 if failed else _number(row.get(name)) for name in names}
    by_point = sorted(points, key=lambda point: point["point"])
    return Run(
        seed=int(row["seed"]),
        origin=f"configuration {row['configuration'] or 'unknown'}, code "
        f"{row['code'] or 'unknown'}" + (f", {row['error']}" if row["error"] else ""),
        failed=failed,
        score=0.0 if failed else _number(row[metric]),
        numbers={name: x for name, x in numbers.items() if math.isfinite(x)},
        curve={
            name: np.array([_number(point[name]) for point in by_point]) for name in _CURVE
        },
        elsewhere=elsewhere,
    )


def _number(value: Any) -> float:
    return math.nan if value is None or value == "" else float(value)


def _hypotheses(
    protocol: Mapping[str, Any], labels: Mapping[str, str]
) -> Iterable[Hypothesis]:
    for one in protocol["hypotheses"]:
        yield Hypothesis(
            one["name"],
            one["task"],
            labels[one["method"]],
            labels[one["against"]],
            one["alternative"],
            one["least_difference"],
        )


def _facts(
    digest: str, protocol: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]
) -> Iterable[tuple[str, str]]:
    yield "protocol", f"{protocol['name']}, sha256 {digest[:12]}..."
    for name, overrides in protocol["tasks"].items():
        steps = f"{protocol['total_steps'][name]:,} steps in all"
        yield f"task {name}", f"{' '.join(overrides)}; {steps}"
    for name, method in protocol["methods"].items():
        yield f"method {name}", " ".join(method["overrides"])
    yield "seeds", ", ".join(map(str, protocol["seeds"]))
    yield (
        "metric",
        f"{protocol['metric']}, of {protocol['num_policies']} policies, each on "
        f"{protocol['episodes']} held-out worlds",
    )
    yield "level of all tests together", f"{protocol['alpha']:g}"
    for name in ("code", "packages"):
        yield name, ", ".join(sorted({str(row[name]) for row in rows if row[name]}))


def _remarks(
    planned: Sequence[Key], rows: Mapping[Key, Any], of_others: int
) -> Iterable[str]:
    missing = sum(key not in rows for key in planned)
    if missing:
        yield (
            f"Registered runs that are missing: {missing} of {len(planned)}. What is said "
            "of tests is preliminary until they are there."
        )
    unplanned = len(set(rows) - set(planned))
    if unplanned:
        yield f"Left out, for the protocol does not name them, runs: {unplanned}."
    if of_others:
        yield f"Left out, for they are of another protocol, runs: {of_others}."


def _sources(
    folder: Path,
    digest: str,
    protocol: Mapping[str, Any],
) -> Iterable[str]:
    yield f"gdrl-report study={protocol['name']}"
    yield f"runs by gdrl-study study={protocol['name']}, protocol {digest[:12]}"
    for name in ("runs.csv", "curves.csv", "elsewhere.csv"):
        path = folder / name
        if path.exists():
            found = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
            yield f"{name} sha256 {found}"
