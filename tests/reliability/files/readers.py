"""What reads the files of a run directory, and files that are not what they were."""

from __future__ import annotations

import contextlib
import csv
import functools
import json
import shutil
from pathlib import Path

import numpy as np
import torch

from gdrl_torchrl.agents.registry import make_actor
from gdrl_torchrl.cli import evaluate
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.files.directory import RunDirectory
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.evaluation import read_evaluation
from gdrl_torchrl.files.metrics import MetricsTable, read_metrics
from gdrl_torchrl.files.policy import load_policy, params_sha256
from gdrl_torchrl.files.trajectories import read_trajectories
from gdrl_torchrl.runs import monitor
from gdrl_torchrl.runs.phases import PHASES
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


@functools.cache
def actor():
    """Gets the policy; the same in all tests."""
    config = load_experiment([*OVERRIDES])
    return make_actor(make_task_of(config), config.network, config.algorithm)


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


@functools.cache
def whole(reader, run):
    """What is read where nothing is wrong."""
    return READERS[reader][1](run)
