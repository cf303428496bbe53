"""The table of ``results/contests`` is what its rows give."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "results" / "contests"


@pytest.fixture(scope="module")
def measure():
    return runpy.run_path(str(FOLDER / "measure.py"))


def test_the_table_is_that_of_the_rows(measure):
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    lines = [line for name in measure["SETTINGS"] for line in measure["table"](name)]
    assert len(lines) > 4
    assert "\n".join(lines) in text
