"""How success grew with what it cost."""

from __future__ import annotations

import math

import numpy as np

from gdrl_torchrl.reports.curves import drawn
from gdrl_torchrl.reports.drawing.figures import MOST_BANDS, Looks, curves_panel
from gdrl_torchrl.reports.evidence import COSTS, Arm, Evidence, Run
from gdrl_torchrl.reports.page.content import (
    Figure,
    Section,
    Table,
    Text,
    count,
    with_limits,
)
from gdrl_torchrl.reports.paper import paper, paper_curves, paper_task
from gdrl_torchrl.reports.statistics.averages import interquartile_mean
from gdrl_torchrl.reports.statistics.bootstrap import Estimate, estimate
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
    tables = [_times(evidence)]
    at_episodes = at_episodes_table(evidence)
    if at_episodes.rows:
        tables.append(at_episodes)
    return Section("learning", "How success grew", (*figures, *tables))


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


def at_episodes_table(evidence: Evidence) -> Table:
    """Success at as many episodes of the agent, and all steps that it took to get there.

    That is how AAMAS 2020 compares methods. The episodes are those that every run of a
    task has had; what has no agent of its own has no row.
    """
    rows = []
    for task in evidence.tasks:
        ended = {
            arm: [run for run in arm.runs if len(drawn(run, "agent_episodes")[0])]
            for arm in evidence.of_task(task)
            if arm.mean("agent_steps") > 0.0
        }
        known = {arm: runs for arm, runs in ended.items() if runs}
        if len(known) < 2:
            continue
        last = [drawn(r, "agent_episodes")[0][-1] for runs in known.values() for r in runs]
        episodes = float(min(last))
        for arm, runs in known.items():
            success = [np.interp(episodes, *drawn(run, "agent_episodes")) for run in runs]
            steps = [_steps_at(run, episodes) for run in runs]
            success += [0.0] * sum(run.failed for run in arm.runs)
            middle = estimate([np.array(success)], interquartile_mean)
            numbers = (count(episodes), with_limits(middle), count(float(np.mean(steps))))
            rows.append((task, arm.method, *numbers))
    return Table(
        "At equal episodes of the agent, as AAMAS 2020 compares: interquartile mean of "
        f"{evidence.words.curve} with its 95 % interval, and the steps of agent and "
        "population that it took to get there",
        ("task", "method", "agent's episodes", "success there", "steps in all by then"),
        rows,
    )


def _steps_at(run: Run, episodes: float) -> float:
    x, y = run.curve["agent_episodes"], run.curve["total_steps"]
    return float(np.interp(episodes, x, y))


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
