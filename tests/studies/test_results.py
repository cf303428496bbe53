"""Tables of results: complete or unchanged, and never edited by hand."""

from __future__ import annotations

import re

import pytest

from gdrl_torchrl.studies.protocol import Job, protocol_of
from gdrl_torchrl.studies.results import (
    CURVE_COLUMNS,
    ELSEWHERE_COLUMNS,
    RUN_COLUMNS,
    StudyResults,
)
from tests.small import toy_study

JOB = {"protocol": "0" * 12, "task": "easy", "method": "ppo", "seed": 3}
TEXTS = ("configuration", "code", "packages", "error")


def run_row(**cells):
    whole = {"agent_steps": 400, "total_steps": 400, "state": "done"}
    return {
        **dict.fromkeys(RUN_COLUMNS, 0),
        **dict.fromkeys(TEXTS, ""),
        **JOB,
        **whole,
        **cells,
    }


def curve_row(point, **cells):
    return {**dict.fromkeys(CURVE_COLUMNS, 0), **JOB, "point": point, **cells}


def elsewhere_row(worlds, **cells):
    return {**dict.fromkeys(ELSEWHERE_COLUMNS, 0), **JOB, "worlds": worlds, **cells}


@pytest.fixture
def results(tmp_path):
    results = StudyResults(tmp_path / "toy")
    results.begin(protocol_of(toy_study()))
    return results


def test_rows_come_back_as_they_were_and_in_order(results):
    later = run_row(seed=4, success_rate=1 / 3, error='a, "b"')
    results.add(
        later,
        [curve_row(2, seed=4), curve_row(1, seed=4, success_rate=0.1)],
        [elsewhere_row("rough", seed=4), elsewhere_row("far", seed=4, timeout_rate=0.3)],
    )
    results.add(run_row(return_mean=float("nan")), [curve_row(1)])
    first, second = results.runs()
    assert second == later
    assert first["return_mean"] != first["return_mean"]
    assert [(r["seed"], r["point"]) for r in results.curves()] == [(3, 1), (4, 1), (4, 2)]
    assert [(r["seed"], r["worlds"]) for r in results.elsewhere()] == [
        (4, "far"),
        (4, "rough"),
    ]
    assert results.elsewhere()[0]["timeout_rate"] == 0.3
    assert results.jobs() == {Job("easy", "ppo", 3): "done", Job("easy", "ppo", 4): "done"}


def test_a_run_is_added_once(results):
    for success in (0.25, 0.75):
        results.add(run_row(success_rate=success), [curve_row(1)])
    (row,) = results.runs()
    assert row["success_rate"] == 0.25


def test_a_curve_without_its_run_does_not_count_and_is_replaced(results, monkeypatch):
    write = StudyResults._write

    def killed_before_runs(self, name, columns, rows):
        if name == "runs.csv":
            raise KeyboardInterrupt
        write(self, name, columns, rows)

    with monkeypatch.context() as patch:
        patch.setattr(StudyResults, "_write", killed_before_runs)
        with pytest.raises(KeyboardInterrupt):
            results.add(run_row(), [curve_row(1), curve_row(2)])
    assert results.curves() == []
    results.add(run_row(), [curve_row(1, success_rate=0.5)])
    assert [row["success_rate"] for row in results.curves()] == [0.5]


@pytest.mark.parametrize("name", ["runs.csv", "curves.csv", "elsewhere.csv"])
@pytest.mark.parametrize(
    ("old", "new"), [(",0.5,", ",0.75,"), ("ppo", "ppp"), ("\n$", ""), (",", ";")]
)
def test_a_row_that_was_changed_by_hand_is_noticed(results, name, old, new):
    results.add(
        run_row(success_rate=0.5),
        [curve_row(1, success_rate=0.5)],
        [elsewhere_row("far", success_rate=0.5)],
    )
    path = results.folder / name
    header, row = path.read_text().split("\n", 1)
    changed = re.sub(old, new, row, count=1) if old != "\n$" else row[:-5]
    assert changed != row
    path.write_text(f"{header}\n{changed}")
    with pytest.raises(ValueError, match=rf"{name}, line 2 was changed or cut off"):
        results.runs(), results.curves(), results.elsewhere()
    with pytest.raises(ValueError, match="changed"):
        results.add(run_row(seed=9), [])
    assert path.read_text() == f"{header}\n{changed}", "what is damaged is left as it is"


def test_a_protocol_that_was_changed_is_noticed_and_another_one_is_refused(results):
    results.begin(protocol_of(toy_study()))
    with pytest.raises(ValueError, match="another protocol has another name"):
        results.begin(protocol_of(toy_study(seeds=[3])))
    path = results.folder / "protocol.json"
    path.write_text(path.read_text().replace('"alpha": 0.05', '"alpha": 0.5'))
    with pytest.raises(ValueError, match="was changed"):
        results.protocol()


@pytest.mark.parametrize(
    "cells",
    [{"success_rate": 1.5}, {"area": float("nan")}, {"state": "fine"}, {"seed": -1}],
)
def test_what_is_no_result_is_not_written(results, cells):
    ((name, value),) = cells.items()
    with pytest.raises(ValueError, match=rf"runs\.csv: {name}={value!r} must be"):
        results.add(run_row(**cells), [])
    assert results.runs() == []
