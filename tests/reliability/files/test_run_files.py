"""Files of a run directory that are damaged, crafted, foreign or hold code."""

from __future__ import annotations

import csv
import io
import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gdrl_torchrl.files import fields
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.metrics import MetricsTable
from gdrl_torchrl.files.run_table import run_row
from gdrl_torchrl.pictures.figures import draw_learning_curve
from tests.reliability.files.readers import (
    COLUMNS,
    JSON_READERS,
    READERS,
    attempt,
    changes,
    read_table,
    replaced,
    whole,
)

of_each = pytest.mark.parametrize("reader", READERS)


@of_each
@settings(max_examples=50)
@given(data=st.data())
def test_a_flipped_bit_is_refused_or_changes_one_entry(reader, data, run):
    file, _, _, has_checksum = READERS[reader]
    content = bytearray((run / file).read_bytes())
    expected = whole(reader, run)
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    with replaced(run / file, bytes(content)):
        found = attempt(reader, run)
    # Of text, a digit may become another one. A name of what is not read, too.
    if found is not None:
        assert changes(found, expected) <= (0 if has_checksum else 2)


@of_each
@settings(max_examples=25)
@given(data=st.data())
def test_a_file_that_was_cut_is_refused_or_nothing_else_is_read(reader, data, run):
    file = READERS[reader][0]
    content = (run / file).read_bytes()
    kept = data.draw(st.integers(0, len(content) - 1))
    expected = whole(reader, run)
    with replaced(run / file, content[:kept]):
        found = attempt(reader, run)
    if found is None:
        return
    if reader == "metrics":
        for name, column in found.items():
            known = np.isfinite(column)
            np.testing.assert_array_equal(
                column[known], expected[name][: len(column)][known]
            )
            assert (known == np.isfinite(expected[name][: len(column)]))[:-1].all()
    elif reader == "table":
        assert expected.items() >= found.items()
    else:
        assert changes(found, expected) == 0


@of_each
def test_what_is_no_such_file_is_refused(reader, run):
    for kind in ("folder", "pipe", "empty", "noise", "zeros"):
        assert_refused_as_no_such_file(reader, kind, run)


def assert_refused_as_no_such_file(reader, kind, run):
    file = READERS[reader][0]
    content = {"noise": np.random.default_rng(0).bytes(3000), "zeros": bytes(3000)}
    with replaced(run / file, content.get(kind, b"")):
        if kind in ("folder", "pipe"):
            (run / file).unlink()
            (os.mkfifo if kind == "pipe" else os.mkdir)(run / file)
        if reader == "table" and kind in ("folder", "pipe"):
            with pytest.raises(RunDirectoryError, match=r"metrics\.csv"):
                MetricsTable(run / file, COLUMNS).cut_after(10)
        elif (reader, kind) == ("table", "empty"):
            # Its first line was not written to its end: the table begins anew.
            assert len(attempt(reader, run)) == 1
        else:
            assert attempt(reader, run) is None


# Code


def torch_file(bomb):
    stream = io.BytesIO()
    torch.save({"weights": bomb}, stream)
    return stream.getvalue()


def numpy_file(bomb):
    stream = io.BytesIO()
    np.savez(stream, position=np.array([bomb], dtype=object))
    return stream.getvalue()


# By kind of file: how it is made, and what sets it off.
BOMBS = {
    "pickle": (pickle.dumps, pickle.loads),
    "torch": (torch_file, lambda x: torch.load(io.BytesIO(x), weights_only=False)),
    "numpy": (numpy_file, lambda x: np.load(io.BytesIO(x), allow_pickle=True)["position"]),
}


@pytest.mark.parametrize("kind", BOMBS)
def test_code_in_a_file_is_not_run(kind, run, bomb_for, tmp_path):
    struck = tmp_path / "struck"
    make, set_off = BOMBS[kind]
    content = make(bomb_for(struck))
    assert not struck.exists()
    for reader, (file, *_) in READERS.items():
        with replaced(run / file, content):
            assert attempt(reader, run) is None, reader
            assert run_row(run)["state"] in ("done", "damaged")
        assert not struck.exists(), reader
    # It would have been, by readers that we do not use.
    set_off(content)
    assert struck.exists()


# Crafted values


def deep(levels):
    return [] if levels == 0 else [deep(levels - 1)]


NEVER = st.sampled_from(
    [
        *(float("nan"), float("inf"), 10**30, -(10**30)),
        *(deep(20), deep(200), {"a": {"b": 1}}),
        *("", "../../x", "/etc/passwd", "${oc.env:HOME}", "???", "x" * 10_000),
        *("\x00", "\ud800", "\x1b[2J"),
    ]
)
"""What no field that is read may hold."""
TEXTS = ("task", "algorithm", "code")
"""Fields that may hold any text that can be printed."""
FIELDS = {
    "evaluation": ["task", "algorithm", "seed", "episodes", "success_rate", "wall_s"],
    "contract": ["params_sha256"],
    "provenance": ["code", "packages"],
    "done": ["code", "evaluation", "costs", "costs.total_steps", "costs.wall_s"],
}
SECTIONS = ("task", "algorithm", "network", "evaluation")


def with_value(path, field, value, *, without=False):
    """The content of a file with another value of a field, or without the field."""
    content = json.loads(path.read_bytes())
    *groups, name = field.split(".")
    inner = content
    for group in groups:
        inner = inner[group]
    if without:
        del inner[name]
    else:
        inner[name] = value
    return json.dumps(content).encode()


def fields_of(reader, run):
    if reader != "config":
        return FIELDS[reader]
    saved = json.loads((run / "config.json").read_text())
    inner = [f"{name}.{field}" for name in SECTIONS for field in saved[name]]
    return [*SECTIONS, *inner]


@pytest.mark.parametrize("reader", JSON_READERS)
@settings(max_examples=80)
@given(data=st.data())
def test_a_value_that_cannot_be_is_refused_by_name(reader, data, run):
    file, read, refusal, _ = READERS[reader]
    field = data.draw(st.sampled_from(fields_of(reader, run)))
    without = data.draw(st.booleans()) and data.draw(st.booleans())
    value = data.draw(NEVER | st.none() | st.booleans() | st.integers(-5, -1))
    if field in TEXTS and fields.TEXT.fits(value) and reader != "config":
        value = ""
    if reader == "config" and not isinstance(value, (str, list, dict, float)):
        # Some fields may be None, True or below zero.
        value = 10**30
    content = with_value(run / file, field, value, without=without)
    with replaced(run / file, content), pytest.raises(refusal) as refused:
        read(run)
    assert Path(file).name in str(refused.value)
    if value != deep(200) or without:
        assert field.rpartition(".")[2] in str(refused.value)
    assert len(str(refused.value)) < 15_000


NO_OBJECTS = (
    *("[]", "3", "null", '"text"', "NaN", "{} {}", "\ufeff{}", "{'a': 1}", "import os"),
    *('{"a": 1, "a": 2}', '{"seed": ' + "1" * 5000 + "}"),
    *("[" * 100_000, '{"a":' * 100_000),
)


@pytest.mark.parametrize("reader", JSON_READERS)
def test_what_is_no_object_is_refused(reader, run):
    for content in NO_OBJECTS:
        for encoded in (content.encode(), content.encode("utf-16")):
            with replaced(run / READERS[reader][0], encoded):
                assert attempt(reader, run) is None, content[:8]


CELLS = ("-1", "nan", "inf", "1e999", "x", "0x10", "\0", '"', "../../x", "", "1" * 5000)


@pytest.mark.parametrize("column", ["agent_steps", "total_steps", "wall_s"])
@pytest.mark.parametrize("reader", ["metrics", "table"])
def test_a_cell_that_cannot_be_is_refused(reader, column, run):
    path = run / "metrics.csv"
    rows = list(csv.reader(path.open()))
    file, read, refusal, _ = READERS[reader]
    for cell in (*CELLS, "1,1"):
        rows[2][rows[0].index(column)] = cell
        content = "".join(",".join(row) + "\r\n" for row in rows)
        with replaced(path, content.encode()), pytest.raises(refusal) as refused:
            read(run)
        assert file in str(refused.value)
        assert "in line 3" in str(refused.value), cell[:8]


def test_a_step_back_is_refused(run):
    rows = (run / "metrics.csv").read_bytes().splitlines(keepends=True)
    with replaced(run / "metrics.csv", b"".join([*rows, rows[1]])):
        assert attempt("metrics", run) is None
        assert attempt("table", run) is None


@pytest.mark.parametrize("column", ["total_steps", "success_rate", "mut_p", "switched"])
def test_a_column_that_is_drawn_or_goes_on_must_be_there(column, run):
    path = run / "metrics.csv"
    content = path.read_bytes().replace(column.encode(), b"other", 1)
    with replaced(path, content):
        with pytest.raises(ValueError, match=rf"metrics\.csv .*{column}"):
            draw_learning_curve(run)
        with pytest.raises(RunDirectoryError, match=r"metrics\.csv .*'other'.* move it"):
            read_table(run)


def test_rows_that_a_resumed_run_misses_are_named(run, caplog, tmp_path):
    table = tmp_path / "metrics.csv"
    rows = (run / "metrics.csv").read_bytes().splitlines(keepends=True)
    table.write_bytes(b"".join(rows[:2]))
    MetricsTable(table, COLUMNS).cut_after(10**6)
    assert str(table) in caplog.text
    assert "to 1000000" in caplog.text
