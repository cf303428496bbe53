"""How success grew with what it cost."""

from __future__ import annotations

import math

from gdrl_torchrl.reports.curves import drawn
from gdrl_torchrl.reports.drawing.figures import MOST_BANDS, Looks, curves_panel
from gdrl_torchrl.reports.evidence import COSTS, Arm, Evidence
from gdrl_torchrl.reports.page.content import Figure, Section, Table, Text, count
from gdrl_torchrl.reports.paper import paper, paper_curves, paper_task
from gdrl_torchrl.reports.statistics.bootstrap import Estimate
from gdrl_torchrl.reports.statistics.times import Crossing, crossing, median_time

_LEVELS = (0.8, 0.9)


def learning_section(evidence: Evidence, looks: Looks) -> Section:
    """Figure 2's panels for every task, and times to thresholds."""
    figures = []
    for number, task in enumerate(evidence.tasks):
        arms = evidence.of_task(task)
        panels = [
            curves_panel(
                f"curves-{number}-{cost}",
                *(arms, cost, looks, evidence.words.curve),
                paper=paper_curves(task) if cost == "agent_episodes" else (),
            )
            for cost in COSTS
            if arms
        ]
        shown = tuple(panel for panel in panels if panel is not None)
        if shown:
            sources = evidence.sources_of([task])
            figures.append(Figure(_caption(task, len(arms)), shown, sources))
    if not figures:
        nothing = Text("These runs have left no curves.")
        return Section("learning", "How success grew", (nothing,))
    return Section("learning", "How success grew", (*figures, _times(evidence)))


def _caption(task: str, methods: int) -> str:
    band = " with its 95 % band" if methods <= MOST_BANDS else ""
    text = (
        f"{task}: every run is a thin line, the thick one is the interquartile mean{band} "
        "at each point, as far as every run has come. A run that failed counts as 0, and "
        "has no line. Point at a line to see its seed and run."
    )
    if paper_task(task) is not None:
        text += (
            " Dashed over the agent's episodes: Figure 2 of the paper "
            f"({paper()['source']}), read off within 0.02: success of training over the "
            "last 100 episodes."
        )
    return text


def _times(evidence: Evidence) -> Table:
    rows = []
    for task in evidence.tasks:
        for arm in evidence.of_task(task):
            cells = [_cell(arm, level) for level in _LEVELS]
            rows.append((arm.task, arm.method, *(x for cell in cells for x in cell)))
    heads = [
        head
        for level in _LEVELS
        for head in (f"reached {level:g}", f"median steps to {level:g}")
    ]
    return Table(
        f"Steps of agent and population until the curve ({evidence.words.curve}) first "
        "reached a level: median over all runs, those that did not get there counted as "
        "watched to their end (Kaplan and Meier), with its 95 % interval",
        ("task", "method", *heads),
        rows,
    )


def _cell(arm: Arm, level: float) -> tuple[str, str]:
    crossings = [_crossing(arm, index, level) for index in range(len(arm.runs))]
    known = [one for one in crossings if one is not None]
    reached = sum(one.reached for one in known)
    time = median_time(known) if known else Estimate(math.nan)
    text = count(time.value)
    if reached:
        text += f" [{count(time.low)}, {count(time.high)}]"
    return f"{reached} of {len(arm.runs)}", text


def _crossing(arm: Arm, index: int, level: float) -> Crossing | None:
    run = arm.runs[index]
    if run.failed:
        # It has not got there, however long it had been given.
        return Crossing(math.inf, reached=False)
    x, y = drawn(run, "total_steps")
    return crossing(x, y, level) if len(x) else None
