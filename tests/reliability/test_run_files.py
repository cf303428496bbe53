"""Files of a run directory that are damaged, crafted, foreign or hold code."""

from __future__ import annotations

import contextlib
import csv
import errno
import functools
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load, save

from gdrl_torchrl.agents.registry import make_actor
from gdrl_torchrl.cli import evaluate, runs
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.files import fields
from gdrl_torchrl.files import trajectories as trajectories_file
from gdrl_torchrl.files.directory import RunDirectory
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.evaluation import read_evaluation
from gdrl_torchrl.files.metrics import MetricsTable, read_metrics
from gdrl_torchrl.files.policy import load_policy, params_sha256, save_policy
from gdrl_torchrl.files.run_table import find_runs, run_row, select_runs
from gdrl_torchrl.files.trajectories import read_trajectories
from gdrl_torchrl.pictures import figures
from gdrl_torchrl.pictures.figures import draw_learning_curve, draw_trajectories
from gdrl_torchrl.runs import evaluate as evaluation
from gdrl_torchrl.runs import monitor
from gdrl_torchrl.runs.phases import PHASES
from gdrl_torchrl.runs.run import run_experiment
from tests.small import tiny_options

POLICY = "final/policy.safetensors"
CONTRACT = "final/contract.json"
OVERRIDES = tiny_options("gppo_water")
COLUMNS = (
    *monitor.COLUMNS,
    *("loss_objective", "loss_critic", "grad_norm"),
    *("kl_approx", "clip_fraction", "explained_variance", "entropy"),
    *PHASES,
)
"""Of a run with PPO."""


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    runs_dir = tmp_path_factory.mktemp("runs")
    return load_experiment([*OVERRIDES, f"runs_dir={runs_dir}"])


@pytest.fixture(scope="module")
def run(config):
    """A run directory; tests leave it as it was."""
    return run_experiment(config)


@functools.cache
def actor():
    """Gets the policy; the same in all tests."""
    config = load_experiment([*OVERRIDES])
    return make_actor(make_task_of(config), config.network, config.algorithm)


@pytest.fixture(scope="module", autouse=True)
def without_episodes():
    """An evaluation reads everything, and runs nothing; runs draw nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "evaluate_policy", lambda *a, **k: {})
        for name in ("draw_learning_curve", "draw_trajectories"):
            patch.setattr(figures, name, lambda path: None)
        yield


@contextlib.contextmanager
def replaced(path, content):
    """A file with another content; None is without the file."""
    whole = path.read_bytes()
    path.unlink()
    try:
        if content is not None:
            path.write_bytes(content)
        yield
    finally:
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        path.write_bytes(whole)


def read_policy(run):
    """Its weights; the actor has others before, and keeps them if there is an error."""
    with torch.no_grad():
        for parameter in actor().parameters():
            parameter.fill_(7.0)
    before = params_sha256(actor())
    try:
        load_policy(run / "final", actor())
    except ValueError:
        assert params_sha256(actor()) == before
        raise
    return params_sha256(actor())


def read_table(run):
    """Rows that a resumed run keeps."""
    again = run / "again.csv"
    shutil.copyfile(run / "metrics.csv", again)
    try:
        MetricsTable(again, COLUMNS).cut_after(10**9)
        return {n: tuple(row) for n, row in enumerate(csv.reader(again.open()))}
    except RunDirectoryError as error:
        raise RunDirectoryError(str(error).replace("again", "metrics")) from error
    finally:
        again.unlink()


def read_config(run):
    evaluate.evaluate_run([f"run={run}"])
    return json.loads((run / "config.json").read_text())


def read_json(name):
    return lambda run: RunDirectory(run).read_json(name)


# By what reads: the file, how, the error, and whether a checksum sees every change.
READERS = {
    "metrics": ("metrics.csv", read_metrics, ValueError, False),
    "table": ("metrics.csv", read_table, RunDirectoryError, False),
    "evaluation": ("evaluation.json", read_evaluation, ValueError, False),
    "trajectories": ("trajectories.npz", read_trajectories, ValueError, True),
    "policy": (POLICY, read_policy, ValueError, True),
    "contract": (CONTRACT, read_policy, ValueError, True),
    "config": ("config.json", read_config, ValueError, False),
    "provenance": ("provenance.json", read_json("provenance.json"), RunDirectoryError, 0),
    "done": ("DONE", read_json("DONE"), RunDirectoryError, False),
}
of_each = pytest.mark.parametrize("reader", READERS)
JSON_READERS = ["evaluation", "contract", "config", "provenance", "done"]


def attempt(reader, run):
    """What is read; None if it is refused as it must be, by the name of the file."""
    file, read, refusal, _ = READERS[reader]
    try:
        return read(run)
    except refusal as error:
        refused = str(error)
    assert Path(file).name in refused
    return None


def changes(found, expected):
    """How many entries differ between two results."""
    if not isinstance(expected, dict):
        return int(found != expected)
    names, both = found.keys() | expected.keys(), found.keys() & expected.keys()
    pairs = [(found[name], expected[name]) for name in both]
    return len(names) - len(both) + sum(entries_changed(*pair) for pair in pairs)


def entries_changed(found, expected):
    if not isinstance(expected, np.ndarray):
        return int(found != expected)
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return found.size + expected.size
    # NaN is what NaN was.
    return int(((found != expected) & ((found == found) | (expected == expected))).sum())


# Damage


@of_each
@settings(max_examples=50)
@given(data=st.data())
def test_a_flipped_bit_is_refused_or_changes_one_entry(reader, data, run):
    file, read, _, has_checksum = READERS[reader]
    whole = bytearray((run / file).read_bytes())
    expected = read(run)
    at = data.draw(st.integers(0, len(whole) - 1))
    whole[at] ^= 1 << data.draw(st.integers(0, 7))
    with replaced(run / file, bytes(whole)):
        found = attempt(reader, run)
    # Of text, a digit may become another one. A name of what is not read, too.
    if found is not None:
        assert changes(found, expected) <= (0 if has_checksum else 2)


@of_each
@settings(max_examples=25)
@given(data=st.data())
def test_a_file_that_was_cut_is_refused_or_nothing_else_is_read(reader, data, run):
    file, read, _, _ = READERS[reader]
    whole = (run / file).read_bytes()
    kept = data.draw(st.integers(0, len(whole) - 1))
    expected = read(run)
    with replaced(run / file, whole[:kept]):
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
@pytest.mark.parametrize("kind", ["folder", "pipe", "empty", "noise", "zeros"])
def test_what_is_no_such_file_is_refused(reader, kind, run):
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


@pytest.mark.parametrize("reader", JSON_READERS)
@pytest.mark.parametrize(
    "content",
    [
        *("[]", "3", "null", '"text"', "NaN", "{} {}", "\ufeff{}", "{'a': 1}", "import os"),
        *('{"a": 1, "a": 2}', '{"seed": ' + "1" * 5000 + "}"),
        *("[" * 100_000, '{"a":' * 100_000),
    ],
    ids=lambda text: text[:8],
)
def test_what_is_no_object_is_refused(reader, content, run):
    for encoded in (content.encode(), content.encode("utf-16")):
        with replaced(run / READERS[reader][0], encoded):
            assert attempt(reader, run) is None


@pytest.mark.parametrize("column", ["agent_steps", "total_steps", "wall_s"])
@pytest.mark.parametrize(
    "cell",
    ["-1", "nan", "inf", "1e999", "x", "0x10", "\0", '"', "../../x", "", "1" * 5000, "1,1"],
    ids=lambda text: text[:8],
)
@pytest.mark.parametrize("reader", ["metrics", "table"])
def test_a_cell_that_cannot_be_is_refused(reader, column, cell, run):
    path = run / "metrics.csv"
    rows = list(csv.reader(path.open()))
    rows[2][rows[0].index(column)] = cell
    content = "".join(",".join(row) + "\r\n" for row in rows)
    file, read, refusal, _ = READERS[reader]
    with replaced(path, content.encode()), pytest.raises(refusal) as refused:
        read(run)
    assert file in str(refused.value)
    assert "in line 3" in str(refused.value)


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


# Policies


def with_weights(run, change):
    """The policy's file with other weights."""
    state = load((run / POLICY).read_bytes())
    change(state, min(state))
    return save(state)


def spoil(value):
    def change(state, name):
        state[name].view(-1)[0] = value

    return change


def rename(state, name):
    state["another"] = state.pop(name)


POLICIES = {
    "other weight": (spoil(0.125), "params_sha256"),
    "nan": (spoil(float("nan")), "not finite"),
    "infinite": (spoil(float("inf")), "not finite"),
    "double": (lambda s, n: s.update({n: s[n].double()}), "float64"),
    "whole": (lambda s, n: s.update({n: s[n].int()}), "int32"),
    "flat": (lambda s, n: s.update({n: s[n].reshape(1, -1)}), r"\[1, "),
    "renamed": (rename, "has no"),
    "further": (lambda s, n: s.update(more=torch.ones(1)), "more"),
    "none": (lambda s, n: s.clear(), "has no"),
}


@pytest.mark.parametrize("case", POLICIES)
def test_a_policy_that_is_another_is_refused(case, run):
    change, said = POLICIES[case]
    said = rf"policy\.safetensors.*{said}"
    with (
        replaced(run / POLICY, with_weights(run, change)),
        pytest.raises(ValueError, match=said),
    ):
        read_policy(run)


@pytest.mark.parametrize("kind", ["F4", "F8_E8M0", "U64", "XYZ"])
def test_weights_of_an_odd_type_are_refused(kind, run):
    size = 1 if kind != "U64" else 16
    entry = {"dtype": kind, "shape": [2], "data_offsets": [0, size]}
    header = json.dumps({"weight": entry}).encode()
    with replaced(run / POLICY, len(header).to_bytes(8, "little") + header + bytes(size)):
        assert attempt("policy", run) is None


def test_a_policy_without_a_contract_is_read_but_not_with_nan(run):
    expected = read_policy(run)
    with replaced(run / CONTRACT, None):
        assert read_policy(run) == expected
        with replaced(run / POLICY, with_weights(run, spoil(float("nan")))):
            assert attempt("policy", run) is None


def test_a_full_disk_leaves_the_policy_before(run, config, tmp_path, monkeypatch):
    folder = shutil.copytree(run / "final", tmp_path / "final")
    write = Path.write_bytes

    def write_half(path, content):
        write(path, content[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", write_half)
        with pytest.raises(OSError, match="No space left"):
            save_policy(folder, actor(), make_task_of(config), config.algorithm_label)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_policy_with_the_contract_of_the_one_before_is_refused(run, config):
    content = (run / CONTRACT).read_bytes()
    with replaced(run / POLICY, (run / POLICY).read_bytes()):
        read_policy(run)
        with torch.no_grad():
            next(actor().parameters()).add_(1.0)
        save_policy(run / "final", actor(), make_task_of(config), config.algorithm_label)
        # The process died before it wrote the second file.
        (run / CONTRACT).write_bytes(content)
        with pytest.raises(ValueError, match=r"expected \w{64} by contract\.json"):
            load_policy(run / "final", actor())
    read_policy(run)


# Trajectories


def put(value):
    def change(array):
        array = array.astype(np.int64 if array.dtype.kind in "iu" else np.float64)
        array.reshape(-1)[0] = value
        return array

    return change


ARRAYS = sorted(trajectories_file._ALWAYS | trajectories_file._WITH_A_SEA)
CHANGES = {
    "text": lambda array: np.full(array.shape, "../../x"),
    "complex": lambda array: np.ones(array.shape, dtype=complex),
    "dates": lambda array: np.ones(array.shape).astype("datetime64[s]"),
    "record": lambda array: np.zeros(array.shape, dtype=[("a", float)]),
    "flat": lambda array: array.reshape(1, 1, 1, -1),
    "empty": lambda array: array[..., None][..., :0],
    "one more": lambda array: np.concatenate([array.reshape(-1)] * 2),
    "infinite": put(np.inf),
    "far": put(10**8),
    "minus": put(-(10**8)),
}


@pytest.fixture(scope="module")
def recorded(run, tmp_path_factory):
    """A folder for trajectories, and whole ones, with a sea."""
    side = np.linspace(-2.0, 2.0, 5)
    sea = {"sea_x": side, "sea_y": side, "sea_elevation": np.zeros((5, 5))}
    return tmp_path_factory.mktemp("recorded"), read_trajectories(run) | sea


def read_crafted(folder, arrays):
    np.savez(folder / "trajectories.npz", **arrays)
    return read_trajectories(folder)


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("change", CHANGES)
def test_an_array_that_cannot_be_is_refused_by_name(name, change, recorded):
    folder, arrays = recorded
    whole = arrays[name]
    if whole.dtype.kind == "U" and change not in ("complex", "flat", "empty"):
        return  # Any texts: the figure refuses those that it has no colour for.
    if whole.dtype.kind in "iu" and change == "infinite":
        return
    crafted = {**arrays, name: CHANGES[change](whole)}
    with pytest.raises(ValueError, match=r"trajectories\.npz") as refused:
        read_crafted(folder, crafted)
    assert name in str(refused.value) or change in ("one more", "empty")


def test_trajectories_need_their_arrays(recorded):
    folder, arrays = recorded
    assert changes(read_crafted(folder, arrays), arrays) == 0
    for name in set(ARRAYS) - {"sea_elevation"}:
        with pytest.raises(ValueError, match=rf"trajectories\.npz has no {name}"):
            read_crafted(folder, {k: v for k, v in arrays.items() if k != name})


def test_a_list_of_arrays_that_ends_early_is_refused(recorded):
    folder, arrays = recorded
    read_crafted(folder, arrays)
    path = folder / "trajectories.npz"
    content = bytearray(path.read_bytes())
    # The last but one says that all after it is a remark.
    entry = content.rfind(b"PK\x01\x02", 0, content.rfind(b"PK\x01\x02"))
    content[entry + 32 : entry + 34] = (60_000).to_bytes(2, "little")
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"npz cannot be read: .*number of arrays"):
        read_trajectories(folder)


def test_an_unknown_outcome_is_not_drawn(recorded):
    folder, arrays = recorded
    read_crafted(folder, {**arrays, "outcome_names": np.array(["../../x"] * 9)})
    with pytest.raises(ValueError, match=r"trajectories\.npz: outcome_names .*x'"):
        draw_trajectories(folder)


def test_a_small_file_with_much_in_it_is_refused(recorded, monkeypatch):
    folder, arrays = recorded
    np.savez_compressed(folder / "trajectories.npz", **arrays, zeros=np.zeros(100_000))
    assert (folder / "trajectories.npz").stat().st_size < 100_000
    monkeypatch.setattr(trajectories_file, "_MOST_BYTES", 500_000)
    with pytest.raises(ValueError, match="more than 500000 bytes"):
        read_trajectories(folder)


# Commands


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
