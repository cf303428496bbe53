"""The table of metrics that a run writes, and goes on with."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.metrics import MetricsTable

COLUMNS = ("total_steps", "success_rate", "wall_s")


@pytest.fixture
def table(tmp_path):
    return MetricsTable(tmp_path / "metrics.csv", COLUMNS)


def lines(table):
    return table.path.read_text().split()


def test_rows_have_blanks_where_nothing_is_known(table):
    table.append({"total_steps": 10, "wall_s": 1.5})
    table.append({"total_steps": 20, "success_rate": None, "wall_s": 2.5})
    assert lines(table) == ["total_steps,success_rate,wall_s", "10,,1.5", "20,,2.5"]


def test_a_table_goes_on_where_it_was(table):
    table.append({"total_steps": 10})
    MetricsTable(table.path, COLUMNS).append({"total_steps": 20})
    assert lines(table)[1:] == ["10,,", "20,,"]


def test_a_metric_without_a_column_is_refused_by_name(table):
    with pytest.raises(ValueError, match="fuel"):
        table.append({"total_steps": 10, "fuel": 1.0})
    assert len(lines(table)) == 1


def test_rows_after_a_step_are_dropped(table):
    for steps in (10, 20, 30):
        table.append({"total_steps": steps, "wall_s": steps / 10})
    table.cut_after(20)
    assert lines(table)[1:] == ["10,,1.0", "20,,2.0"]


@given(kept=st.integers(0, 100), last=st.integers(100, 250))
def test_a_last_row_that_was_cut_short_is_dropped(kept, last, tmp_path_factory):
    path = tmp_path_factory.mktemp("table") / "metrics.csv"
    table = MetricsTable(path, COLUMNS)
    table.append({"total_steps": 50, "success_rate": 0.5, "wall_s": 1.0})
    whole = path.read_bytes()
    # The process dies while it writes the row of a step that was never saved.
    table.append({"total_steps": last, "success_rate": 0.25, "wall_s": 2.125})
    row = path.read_bytes()[len(whole) :]
    path.write_bytes(whole + row[: kept * (len(row) - 2) // 100])
    MetricsTable(path, COLUMNS).cut_after(99)
    assert lines(table)[1:] == ["50,0.5,1.0"]


def test_a_damaged_table_is_named(table):
    table.path.write_text("total_steps,wall_s\nten,1.0\n")
    with pytest.raises(RunDirectoryError, match=r"metrics\.csv is damaged"):
        table.cut_after(10)


def test_a_table_that_was_cut_in_its_header_begins_anew(table):
    table.path.write_bytes(table.path.read_bytes()[:7])
    again = MetricsTable(table.path, COLUMNS)
    again.cut_after(0)
    again.append({"total_steps": 10})
    assert lines(table) == ["total_steps,success_rate,wall_s", "10,,"]
