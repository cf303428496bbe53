"""Pages of studies that are committed are what their committed results give."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdrl_torchrl.reports.of_study import read_study
from gdrl_torchrl.reports.report import write_report

ROOT = Path(__file__).parents[2]
PAGES = sorted(path.parent for path in (ROOT / "docs" / "reports").glob("*/report.md"))


def test_there_are_pages():
    assert PAGES


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_a_page_is_what_the_results_of_its_study_give(page, tmp_path):
    write_report(read_study(ROOT / "results" / page.name), tmp_path)
    assert (page / "report.md").read_text() == (tmp_path / "report.md").read_text()
    names = [sorted(p.name for p in (f / "figures").iterdir()) for f in (page, tmp_path)]
    assert names[0] == names[1]
