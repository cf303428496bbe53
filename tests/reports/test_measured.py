"""Tables of what was measured beside studies are what its rows give."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

RESULTS = Path(__file__).parents[2] / "results"


def lines_of(name):
    measured = runpy.run_path(str(RESULTS / name / "measure.py"))
    if name == "contests":
        return [
            line for setting in measured["SETTINGS"] for line in measured["table"](setting)
        ]
    return measured["table"]()


@pytest.mark.parametrize("name", ["contests", "first_children"])
def test_a_table_is_that_of_the_rows(name):
    text = (RESULTS / name / "README.md").read_text(encoding="utf-8")
    lines = lines_of(name)
    assert len(lines) > 4
    assert "\n".join(lines) in text
