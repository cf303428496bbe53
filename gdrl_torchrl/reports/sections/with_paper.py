"""Table 1 of the paper beside ours."""

from __future__ import annotations

from gdrl_torchrl.reports.evidence import Arm, Evidence
from gdrl_torchrl.reports.page.content import UNKNOWN, Section, Table, Text, number
from gdrl_torchrl.reports.paper import paper, paper_method, paper_table

_NUMBERS = {"return_mean": 1, "episode_steps": 0, "episode_s": 1, "speed_m_s": 2}
"""Ours, with their digits."""
_OF_PAPER = ("reward", "steps", "time_s", "speed_m_s")


def paper_section(evidence: Evidence) -> Section | None:
    """The table; None if no task of the evidence is one of the paper's."""
    rows = []
    for task in evidence.tasks:
        theirs = {row["method"]: row for row in paper_table(task)}
        for arm in evidence.of_task(task) if theirs else ():
            rows.append((task, arm.method, "ours", *_ours(arm)))
            row = theirs.get(paper_method(arm.method) or "")
            if row is not None:
                texts = [f"{row[name]:g}" if name in row else UNKNOWN for name in _OF_PAPER]
                rows.append((task, row["method"], "paper", *texts))
    if not rows:
        return None
    table = Table(
        f"Table 1 of the paper ({paper()['source']}) beside our final policies, means over "
        "seeds",
        (
            "task",
            "method",
            "",
            "reward",
            "steps of an episode",
            "simulated time (s)",
            "speed (m/s)",
        ),
        rows,
    )
    note = Text(
        "The paper measured on goals that every model could reach, and states neither its "
        "arena nor its limit of steps; ours are all held-out worlds, and episodes that "
        "fail are counted with their length. The rows say whether sizes are alike, no more."
    )
    return Section("paper", "Beside the paper", (note, table))


def _ours(arm: Arm) -> list[str]:
    return [number(arm.mean(name), digits) for name, digits in _NUMBERS.items()]
