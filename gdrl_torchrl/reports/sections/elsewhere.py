"""How final policies do in worlds other than those that they were trained for."""

from __future__ import annotations

import numpy as np

from gdrl_torchrl.reports.evidence import Arm, Evidence
from gdrl_torchrl.reports.page.content import Section, Table, number, with_limits
from gdrl_torchrl.reports.statistics.bootstrap import estimate


def elsewhere_section(evidence: Evidence) -> Section | None:
    """The table; None if no run was evaluated elsewhere."""
    table = elsewhere_table(evidence)
    return Section("elsewhere", "In other worlds", (table,)) if table.rows else None


def elsewhere_table(evidence: Evidence) -> Table:
    """A row for each method and kind of worlds."""
    rows = [
        (task, worlds, arm.method, *_cells(arm, worlds))
        for task in evidence.tasks
        for worlds in _worlds(evidence.of_task(task))
        for arm in evidence.of_task(task)
    ]
    return Table(
        "Greedy success of final policies in worlds that no run was trained for: mean over "
        "runs with its 95 % interval, worst run, and the mean difference to the held-out "
        "worlds of the task itself",
        ("task", "worlds", "method", "runs", "success", "worst", "difference"),
        rows,
    )


def _worlds(arms: tuple[Arm, ...]) -> list[str]:
    return list(dict.fromkeys(w for arm in arms for run in arm.runs for w in run.elsewhere))


def _cells(arm: Arm, worlds: str) -> tuple[str, str, str, str]:
    runs = [run for run in arm.runs if worlds in run.elsewhere]
    there = np.array([run.elsewhere[worlds] for run in runs])
    here = np.array([run.numbers["success_rate"] for run in runs])
    if not runs:
        return "0", number(np.nan), number(np.nan), number(np.nan)
    success = with_limits(estimate([there], np.mean))
    return str(len(runs)), success, number(there.min()), number((there - here).mean())
