"""What each method reached on each task, and what it cost."""

from __future__ import annotations

import math

from gdrl_torchrl.reports.drawing.figures import Looks, scores_panel
from gdrl_torchrl.reports.evidence import Arm, Evidence
from gdrl_torchrl.reports.page.content import (
    UNKNOWN,
    Figure,
    Section,
    Table,
    Text,
    count,
    number,
    with_limits,
)
from gdrl_torchrl.reports.paper import paper
from gdrl_torchrl.reports.statistics.averages import interquartile_mean, worst_quartile
from gdrl_torchrl.reports.statistics.bootstrap import estimate


def reached_table(evidence: Evidence) -> Table:
    """The main table: a row for each method on each task."""
    name = evidence.words.score_name
    return Table(
        f"Interquartile mean (IQM) of {evidence.words.score}, with its 95 % interval; mean "
        "of the worst quarter of the runs; final success over held-out worlds",
        (
            "task",
            "method",
            "runs",
            f"IQM of {name}",
            f"worst quarter of {name}",
            "success, greedy",
            "success, sampled",
        ),
        [
            (
                arm.task,
                arm.method,
                str(len(arm.runs)),
                with_limits(estimate([arm.scores], interquartile_mean)),
                number(worst_quartile(arm.scores)),
                number(arm.mean("success_rate")),
                number(arm.mean("success_rate_sampled")),
            )
            for arm in _arms(evidence)
        ],
    )


def costs_table(evidence: Evidence) -> Table:
    """What runs have cost: a row for each method on each task."""
    return Table(
        "What a run that ended has cost, means",
        (
            "task",
            "method",
            "steps in all",
            "share of the population",
            "agent's episodes",
            "wall time (s)",
            "switches of evaluations",
        ),
        [
            (
                arm.task,
                arm.method,
                count(arm.mean("total_steps")),
                number(_ratio(arm, "population_steps", "total_steps"), 2),
                count(arm.mean("agent_episodes")),
                count(arm.mean("wall_s")),
                _switches(arm),
            )
            for arm in _arms(evidence)
        ],
    )


def scores_section(evidence: Evidence, looks: Looks) -> Section:
    """The main tables, and every run as a dot."""
    name = evidence.words.score_name
    panels = tuple(
        scores_panel(f"scores-{k}", evidence.of_task(task), looks, f"{name} on {task}")
        for k, task in enumerate(evidence.tasks)
        if evidence.of_task(task)
    )
    figure = Figure(
        f"Every run's {name} (dots; crosses are runs that failed), and the interquartile "
        "mean with its 95 % interval (diamonds). Point at a dot to see its seed and run.",
        panels,
        evidence.sources_of(evidence.tasks),
    )
    tables = (reached_table(evidence), costs_table(evidence))
    return Section("scores", "What was reached", (*tables, Text(_known()), figure))


def _arms(evidence: Evidence) -> list[Arm]:
    return [arm for task in evidence.tasks for arm in evidence.of_task(task)]


def _ratio(arm: Arm, part: str, whole: str) -> float:
    total = arm.column(whole).sum()
    return float(arm.column(part).sum() / total) if total else math.nan


def _switches(arm: Arm) -> str:
    evaluations = arm.mean("evaluations")
    if not evaluations > 0.0:
        return UNKNOWN
    rate = _ratio(arm, "switches", "evaluations")
    return f"{arm.mean('switches'):.1f} of {evaluations:.1f} ({rate:.2f})"


def _known() -> str:
    known = [
        f"{row['switches']} of {row['evaluations']} with {row['method']} "
        f"({row['switches'] / row['evaluations']:.2f})"
        for row in paper()["switches"]
    ]
    return f"The paper's figures for switches: about {' and '.join(known)}."
