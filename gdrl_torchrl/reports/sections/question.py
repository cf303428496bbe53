"""What was asked, what was registered, and what has been run of it."""

from __future__ import annotations

from collections import Counter

from gdrl_torchrl.reports.evidence import Arm, Evidence
from gdrl_torchrl.reports.page.content import Section, Table, Text


def question_section(evidence: Evidence) -> Section:
    """The question, the protocol, and runs that ended, failed or are missing."""
    text = evidence.question or "Nobody has written down a question before these runs."
    facts = Table("What this page is made of", ("what", "is"), list(evidence.facts))
    remarks = tuple(Text(remark) for remark in evidence.remarks)
    blocks = (Text(text), facts, *_runs(evidence), *remarks)
    return Section("question", "Question and protocol", blocks)


def _runs(evidence: Evidence) -> list[Text | Table]:
    """Which runs there are: in a sentence for all methods that have the same ones."""
    whole = [arm for arm in evidence.arms if _seeds(arm)[1:] == ("none", "none")]
    usual = Counter(_seeds(arm)[0] for arm in whole).most_common(1)
    same = [arm for arm in whole if usual and _seeds(arm)[0] == usual[0][0]]
    if len(same) < 2:
        same = []
    rows = [(a.task, a.method, *_seeds(a)) for a in evidence.arms if a not in same]
    found: list[Text | Table] = []
    if same:
        number, _, seeds = _seeds(same[0])[0].partition(": ")
        which = f"{len(same)} of {len(evidence.arms)}" if rows else f"All {len(same)}"
        found.append(
            Text(
                f"{which} pairs of task and method have the same {number} seeds ({seeds}): "
                "none failed, none is missing."
            )
        )
    if rows:
        columns = ("task", "method", "seeds that ended", "failed", "missing")
        title = "What was run. A run that failed counts as 0."
        found.append(Table(title, columns, rows))
    return found


def _seeds(arm: Arm) -> tuple[str, str, str]:
    ended = [run.seed for run in arm.runs if not run.failed]
    failed = [run.seed for run in arm.runs if run.failed]
    texts = (_listed(ended), _listed(failed), _listed(list(arm.missing)))
    return (f"{len(ended)}: {texts[0]}" if ended else "none", texts[1], texts[2])


def _listed(seeds: list[int]) -> str:
    """Seeds with runs of neighbours as ranges.

    Examples:
        >>> _listed([0, 1, 2, 5, 7, 8])
        '0 to 2, 5, 7, 8'
        >>> _listed([])
        'none'
    """
    groups: list[list[int]] = []
    for seed in sorted(seeds):
        if groups and seed == groups[-1][-1] + 1:
            groups[-1].append(seed)
        else:
            groups.append([seed])
    parts = [f"{g[0]} to {g[-1]}" if len(g) > 2 else ", ".join(map(str, g)) for g in groups]
    return ", ".join(parts) or "none"
