"""The report on some evidence: all its sections, written as pages."""

from __future__ import annotations

from pathlib import Path

from gdrl_torchrl.reports.drawing.figures import looks_of
from gdrl_torchrl.reports.evidence import Evidence
from gdrl_torchrl.reports.page.content import Section
from gdrl_torchrl.reports.page.write import write_pages
from gdrl_torchrl.reports.sections.comparison import comparison_section
from gdrl_torchrl.reports.sections.elsewhere import elsewhere_section
from gdrl_torchrl.reports.sections.hypotheses import hypotheses_section
from gdrl_torchrl.reports.sections.learning import learning_section
from gdrl_torchrl.reports.sections.question import question_section
from gdrl_torchrl.reports.sections.scores import scores_section
from gdrl_torchrl.reports.sections.seeds import seeds_section
from gdrl_torchrl.reports.sections.with_paper import paper_section


def sections_of(evidence: Evidence) -> list[Section]:
    """All sections that the evidence has something for."""
    looks = looks_of(evidence.methods)
    found = [
        question_section(evidence),
        scores_section(evidence, looks),
        hypotheses_section(evidence) if evidence.hypotheses else None,
        comparison_section(evidence, looks),
        learning_section(evidence, looks),
        elsewhere_section(evidence),
        paper_section(evidence),
        seeds_section(evidence),
    ]
    return [section for section in found if section is not None]


def write_report(evidence: Evidence, folder: Path) -> Path:
    """Write the report.

    Args:
        evidence: What it is on.
        folder: Where ``report.html``, ``report.md`` and ``figures/`` go.

    Returns:
        The page of HTML.

    Raises:
        ValueError: If there is no run to report on.
        OSError: If a file cannot be written.
    """
    if not any(arm.runs for arm in evidence.arms):
        raise ValueError(f"{evidence.title}: there is no run that has ended or failed")
    return write_pages(folder, evidence.title, sections_of(evidence))
