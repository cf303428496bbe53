"""No figure of a result is typed into a text: each stands between marks, or in a table."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ALGORITHMS = sorted((ROOT / "docs" / "algorithms").glob("*.md"))
WHOLE = [ROOT / "README.md", ROOT / "docs" / "findings.md"]
MARKED = re.compile(r"<!-- gdrl [^>]*-->.*?<!-- / -->", re.DOTALL)
NOT_SAID = re.compile(
    r"```.*?```|`[^`]*`|\]\([^)]*\)|^\[[^\]]*\]: [^\n]*$|Python 3\.11 or 3\.12",
    re.DOTALL | re.MULTILINE,
)
FIGURE = re.compile(r"\d+\.\d+|\d+ ?%")


def typed_figures(text):
    """Numbers with decimals and percentages outside of marks, code, links and versions."""
    return FIGURE.findall(NOT_SAID.sub("", MARKED.sub("", text)))


def results_of(page):
    return page.read_text(encoding="utf-8").partition("\n## Results\n")[2]


@pytest.mark.parametrize("page", ALGORITHMS, ids=lambda page: page.stem)
def test_results_of_algorithms_come_from_studies_alone(page):
    results = results_of(page)
    assert results.strip()
    assert not typed_figures(results)


@pytest.mark.parametrize("text", WHOLE, ids=lambda page: page.stem)
def test_figures_of_readme_and_findings_come_from_studies_alone(text):
    assert not typed_figures(text.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("PPO has 0.5, or 30 %.", ["0.5", "30 %"]),
        ("<!-- gdrl study=a figure=b -->0.5\n0.6<!-- / --> and 0.7", ["0.7"]),
        ("`mut_v=0.1` of [a page](0.2.md), ten seeds of 2020\n\n[x]: y/1.2", []),
    ],
)
def test_a_typed_figure_is_found(text, found):
    assert typed_figures(text) == found
