"""Methods against each other, without hypotheses."""

from __future__ import annotations

import numpy as np

from gdrl_torchrl.reports.drawing.figures import (
    MOST_BANDS,
    Looks,
    differences_panel,
    profiles_panel,
)
from gdrl_torchrl.reports.evidence import Arm, Evidence
from gdrl_torchrl.reports.page.content import (
    UNKNOWN,
    Figure,
    Section,
    Table,
    Text,
    number,
    with_limits,
)
from gdrl_torchrl.reports.statistics.averages import stratified_iqm
from gdrl_torchrl.reports.statistics.bootstrap import estimate
from gdrl_torchrl.reports.statistics.comparisons import welch
from gdrl_torchrl.reports.statistics.probabilities import (
    improvement_over_tasks,
    mean_with_limits,
    wilson_limits,
)

_THRESHOLDS = np.linspace(0.0, 1.0, 101)


def comparison_section(evidence: Evidence, looks: Looks) -> Section:
    """Probability of improvement by task and over tasks, IQM over tasks, and profiles."""
    blocks: list[Table | Figure] = [
        _improvements(evidence, [arm.method for arm in evidence.of_task(task)], (task,))
        for task in evidence.tasks
        if len(evidence.of_task(task)) > 1 and task not in evidence.baselines
    ]
    beside = beside_baseline_table(evidence)
    if beside.rows:
        blocks[:0] = [beside, _differences(evidence, looks)]
    methods = list(evidence.on_all_tasks())
    if len(evidence.tasks) > 1 and len(methods) > 1:
        blocks += [_over_tasks(evidence, methods)]
        blocks += [_improvements(evidence, methods, evidence.tasks)]
    note = Text(
        "These are of many pairs, not of registered hypotheses: they describe, and an "
        "interval that leaves out no difference, or one half, is no test among so many."
    )
    return Section(
        "comparison",
        "Method against method",
        (note, *blocks, _profiles(evidence, methods, looks)),
    )


def beside_baseline_table(evidence: Evidence) -> Table:
    """A row for each method beside the baseline of its task."""
    name = evidence.words.score_name
    rows = [
        (
            *(task, arm.method, base.method, f"{len(arm.runs)}, {len(base.runs)}"),
            *_beside(arm.scores, base.scores),
        )
        for task, base, others in _with_baselines(evidence)
        for arm in others
    ]
    return Table(
        f"Every method beside the baseline of its task: difference of mean {name} with its "
        "95 % interval (Welch), and the probability that a run of the method has a higher "
        f"{name} than one of the baseline",
        ("task", "method", "baseline", "runs", "difference", "improvement"),
        rows,
    )


def _differences(evidence: Evidence, looks: Looks) -> Figure:
    """The differences of :func:`beside_baseline_table`, drawn."""
    name = evidence.words.score_name
    panels = []
    for k, (task, base, others) in enumerate(_with_baselines(evidence)):
        found = {arm.method: welch(arm.scores, base.scores)[0] for arm in others}
        label = f"difference of mean {name} to {base.method} on {task}"
        panels.append(differences_panel(f"differences-{k}", found, looks, label))
    return Figure(
        f"Difference of mean {name} to the baseline of the task, the line at zero, with "
        "its 95 % interval (Welch).",
        tuple(panels),
        evidence.sources_of(list(evidence.baselines)),
    )


def _with_baselines(evidence: Evidence) -> list[tuple[str, Arm, list[Arm]]]:
    """Tasks whose baseline and another method have runs: the task, its baseline, others."""
    found = []
    for task, baseline in evidence.baselines.items():
        arms = evidence.of_task(task)
        others = [arm for arm in arms if arm.method != baseline]
        if others and len(others) < len(arms):
            found.append((task, evidence.arm(task, baseline), others))
    return found


def summary_table(evidence: Evidence) -> Table:
    """A row for each method: what it reached, and how it stands beside the baseline."""
    name = evidence.words.score_name
    rows = []
    for arm in (arm for task in evidence.tasks for arm in evidence.of_task(task)):
        baseline = evidence.baselines.get(arm.task, "")
        base = evidence.arm(arm.task, baseline).scores
        beside = (UNKNOWN, UNKNOWN)
        if len(base) and arm.method != baseline:
            beside = _beside(arm.scores, base)
        rows.append(
            (
                *(arm.task, arm.method, str(len(arm.runs))),
                *(number(float(arm.scores.mean())), number(arm.mean("success_rate"))),
                *beside,
            )
        )
    return Table(
        f"Mean {name} and final success of each method, and beside the baseline of its "
        f"task the difference of mean {name} with its 95 % interval (Welch) and the "
        "probability that a run of the method has the higher one",
        ("task", "method", "runs", name, "success at the end", "difference", "improvement"),
        rows,
    )


def by_task_table(evidence: Evidence) -> Table:
    """A row for each method and a column for each task: many arms at one glance."""
    name = evidence.words.score_name

    def cell(method: str, task: str) -> str:
        scores = evidence.arm(task, method).scores
        if not len(scores):
            return UNKNOWN
        baseline = evidence.baselines.get(task, "")
        base = evidence.arm(task, baseline).scores
        mean = number(float(scores.mean()))
        if not len(base) or method == baseline:
            return mean
        return f"{mean} ({_beside(scores, base)[1]})"

    return Table(
        f"Mean {name} of each method by task, and in brackets the probability that a run "
        "of it has a higher one than a run of the task's baseline, with its 95 % interval",
        ("method", *evidence.tasks),
        [(m, *(cell(m, task) for task in evidence.tasks)) for m in evidence.methods],
    )


def _beside(scores: np.ndarray, base: np.ndarray) -> tuple[str, str]:
    """Difference of means and probability of improvement, with their limits."""
    improvement = improvement_over_tasks([(scores, base)])
    return with_limits(welch(scores, base)[0]), with_limits(improvement, 2)


def _improvements(evidence: Evidence, methods: list[str], tasks: tuple[str, ...]) -> Table:
    """A row and a column per method."""
    name = evidence.words.score_name

    def cell(row: str, column: str) -> str:
        if row == column:
            return UNKNOWN
        pairs = [[evidence.arm(t, m).scores for m in (row, column)] for t in tasks]
        return with_limits(improvement_over_tasks([(x, y) for x, y in pairs]), 2)

    where = tasks[0] if len(tasks) == 1 else "all tasks, each with the same weight"
    return Table(
        f"{where}: probability that a run of the row's method has a higher {name} than one "
        "of the column's, with its 95 % interval",
        ("", *methods),
        [(row, *(cell(row, column) for column in methods)) for row in methods],
    )


def _over_tasks(evidence: Evidence, methods: list[str]) -> Table:
    name = evidence.words.score_name
    rows = []
    for method in methods:
        strata = [evidence.arm(task, method).scores for task in evidence.tasks]
        rows.append((method, with_limits(estimate(strata, stratified_iqm))))
    return Table(
        f"IQM of {name} over the runs of all tasks together, with its stratified 95 % "
        "interval",
        ("method", f"IQM of {name}"),
        rows,
    )


def _profiles(evidence: Evidence, methods: list[str], looks: Looks) -> Figure:
    """Performance profiles (Agarwal et al. 2021, section 4.2), by task and over tasks."""
    name = evidence.words.score_name
    panels = [
        profiles_panel(
            f"profiles-{k}",
            {arm.method: _profile([arm.scores]) for arm in evidence.of_task(task)},
            looks,
            f"{name} on {task}",
        )
        for k, task in enumerate(evidence.tasks)
        if evidence.of_task(task)
    ]
    if len(evidence.tasks) > 1 and methods:
        profiles = {
            method: _profile([evidence.arm(task, method).scores for task in evidence.tasks])
            for method in methods
        }
        panels.append(profiles_panel("profiles", profiles, looks, f"{name}, all tasks"))
    return Figure(
        f"Performance profiles: share of runs whose {name} is above τ, with 95 % bands at "
        f"each τ where there are no more than {MOST_BANDS} methods. A curve that is higher "
        "everywhere is that of a better method.",
        tuple(panels),
        evidence.sources_of(evidence.tasks),
    )


def _profile(scores: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Thresholds, mean over tasks of the share above them, and its limits, ``[T]`` each."""
    shares = np.array([np.mean(s[None, :] > _THRESHOLDS[:, None], axis=1) for s in scores])
    limits = [wilson_limits(p, len(s)) for p, s in zip(shares, scores, strict=True)]
    low, high = (np.array(side) for side in zip(*limits, strict=True))
    return _THRESHOLDS, *mean_with_limits(shares, low, high)
