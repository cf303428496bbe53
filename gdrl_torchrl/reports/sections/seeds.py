"""Every run by itself."""

from __future__ import annotations

import math

from gdrl_torchrl.reports.evidence import Evidence, Run
from gdrl_torchrl.reports.page.content import Section, Table, count, number


def seeds_section(evidence: Evidence) -> Section:
    """A row per run, with what it was made of."""
    name = evidence.words.score_name
    table = Table(
        "All runs",
        (
            "task",
            "method",
            "seed",
            name,
            "success, greedy",
            "success, sampled",
            "steps in all",
            "wall time (s)",
            "made of",
        ),
        [
            (arm.task, arm.method, str(run.seed), *_cells(run))
            for task in evidence.tasks
            for arm in evidence.of_task(task)
            for run in arm.runs
        ],
        folded=True,
    )
    return Section("seeds", "Every run", (table,))


def _cells(run: Run) -> tuple[str, ...]:
    known = run.numbers.get
    return (
        "0 (failed)" if run.failed else number(run.score),
        number(known("success_rate", math.nan)),
        number(known("success_rate_sampled", math.nan)),
        count(known("total_steps", math.nan)),
        count(known("wall_s", math.nan)),
        run.origin,
    )
