"""What was asked, what was registered, and what has been run of it."""

from __future__ import annotations

from gdrl_torchrl.reports.evidence import Arm, Evidence
from gdrl_torchrl.reports.page.content import Section, Table, Text


def question_section(evidence: Evidence) -> Section:
    """The question, the protocol, and runs that ended, failed or are missing."""
    text = evidence.question or "Nobody has written down a question before these runs."
    facts = Table("What this page is made of", ("what", "is"), list(evidence.facts))
    runs = Table(
        "What was run. A run that failed counts as 0.",
        ("task", "method", "seeds that ended", "failed", "missing"),
        [(arm.task, arm.method, *_seeds(arm)) for arm in evidence.arms],
    )
    remarks = tuple(Text(remark) for remark in evidence.remarks)
    return Section("question", "Question and protocol", (Text(text), facts, runs, *remarks))


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
