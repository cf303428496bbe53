"""Commands over runs that are damaged."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys

import pytest

from gdrl_torchrl.cli import evaluate, runs
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.run_table import find_runs, select_runs
from gdrl_torchrl.runs.run import run_experiment
from tests.reliability.files.readers import (
    READERS,
    replaced,
)


def said_by(main, arguments, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["command", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    # A text: printed on standard error, and the exit code is 1.
    return stop.value.code


@pytest.mark.parametrize("reader", ["config", "policy", "contract"])
def test_evaluating_a_damaged_run_ends_with_an_error(reader, run, monkeypatch):
    path = run / READERS[reader][0]
    for content in (b"{", path.read_bytes()[:-20], b"\x80\x04N.", b"{}", b"\xff" * 99):
        with replaced(path, content):
            said = said_by(evaluate.main, [f"run={run}"], monkeypatch)
        assert said.startswith(f"error: {path}")


@pytest.mark.parametrize(
    "cells", [[8, 9], [8], [8, 8, 8]], ids=["wider", "a layer less", "a layer more"]
)
def test_a_config_that_makes_another_network_is_named_beside_the_policy(cells, run):
    path = run / "config.json"
    config = json.loads(path.read_text())
    assert config["network"]["actor_cells"] == [8, 8]
    config["network"]["actor_cells"] = cells
    with (
        replaced(path, json.dumps(config).encode()),
        pytest.raises(ValueError, match=re.escape(str(path))) as refusal,
    ):
        evaluate.evaluate_run([f"run={run}"])
    assert str(run / READERS["policy"][0]) in str(refusal.value)


@pytest.mark.parametrize("file", ["config.json", "metrics.csv", "evaluation.json"])
def test_a_table_names_damaged_runs_and_shows_the_others(
    file, run, tmp_path, monkeypatch, capsys
):
    for seed in range(3):
        shutil.copytree(run, tmp_path / f"seed_{seed}")
    damaged = tmp_path / "seed_1"
    if file == "metrics.csv":
        (damaged / "DONE").unlink()
    (damaged / file).write_bytes(b"\x80\x04N.\n1,2\n")
    said = said_by(runs.main, [str(tmp_path)], monkeypatch)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:]] == ["done", "damaged", "done"]
    assert said.startswith("error: ")
    assert str(damaged / file) in said
    assert said.count("\n") == 0, "one error for one run"


def test_a_filter_keeps_runs_that_cannot_be_read(run, tmp_path):
    for seed in range(2):
        shutil.copytree(run, tmp_path / f"seed_{seed}")
    (tmp_path / "seed_1" / "config.json").write_text("{")
    found = find_runs(tmp_path)
    assert len(found) == 2
    assert select_runs(found, {"task.sea": "rough"}) == [tmp_path / "seed_1"]
    assert select_runs(found, {"task.sea": "calm", "state": "done"}) == found


def test_names_that_cannot_be_printed_do_not_end_the_table(run, tmp_path, capsysbinary):
    for name in ("two\nlines", os.fsdecode(b"\xff\xfe"), "\x1b[2J"):
        shutil.copytree(run, tmp_path / name / "key" / "seed_0")
    lines = runs.list_runs([str(tmp_path)]).splitlines()
    assert len(lines) == 4
    assert "".join(lines).isprintable()


def test_a_run_with_a_damaged_mark_does_not_go_on(config, run):
    for content in (b"", b"{}", b"\x80\x04N.", b"[1]"):
        with replaced(run / "DONE", content):
            with pytest.raises(RunDirectoryError, match=r"DONE.*remove this file"):
                run_experiment(config)
            assert (run / "DONE").read_bytes() == content
    assert run_experiment(config) == run


@pytest.mark.parametrize("command", ["evaluate", "runs"])
def test_the_commands_fail_without_a_trace(command, run):
    argument = f"run={run}" if command == "evaluate" else str(run)
    with replaced(run / "config.json", b'{"task": {"name": ["water"]}}'):
        ended = subprocess.run(
            [sys.executable, "-m", f"gdrl_torchrl.cli.{command}", argument],
            capture_output=True,
            text=True,
            check=False,
        )
    assert ended.returncode == 1
    assert ended.stderr.startswith(f"error: {run / 'config.json'}")
    assert "Traceback" not in ended.stderr
