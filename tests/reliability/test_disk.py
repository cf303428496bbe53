"""A disk that is full, at whatever point of a run."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from gdrl_torchrl.analysis import figures
from gdrl_torchrl.cli.compose import load_experiment
from gdrl_torchrl.training.run import run_experiment
from gdrl_torchrl.training.run_directory import RunDirectoryError

SIZE_KB = 4096
ROOM_KB = (0, 4, 12, 24, 48, 100, 160, 240, 400)
"""Room that a run finds: for nothing at all, up to most of it."""


@pytest.fixture
def small_disk(tmp_path):
    """A folder on a file system of four megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_KB}k", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"a small file system cannot be mounted here: {error}")
    if mounted.returncode:
        pytest.skip(f"a small file system cannot be mounted here: {mounted.stderr}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture
def run_on(options_of, monkeypatch):
    for name in ("draw_learning_curve", "draw_trajectories"):
        monkeypatch.setattr(figures, name, lambda path: None)

    def run(folder):
        small = ["budget.agent_steps=400", "checkpoint.interval_s=0"]
        options = [*options_of("gppo_water"), *small, f"runs_dir={folder}"]
        return run_experiment(load_experiment(options))

    return run


def leave_room(disk, kilobytes):
    """Fill a file system until there is room for so much; the file that fills it."""
    filler = disk / "filler"
    filler.write_bytes(bytes(shutil.disk_usage(disk).free - 1024 * kilobytes))
    return filler


def test_a_full_disk_is_named_and_nothing_that_was_saved_is_lost(
    small_disk, run_on, tmp_path, rows_of, evaluation_of
):
    whole = run_on(tmp_path / "whole")
    refused = {}
    for kilobytes in ROOM_KB:
        filler = leave_room(small_disk, kilobytes)
        try:
            run_on(small_disk / "runs")
        except RunDirectoryError as error:
            refused[kilobytes] = str(error)
        filler.unlink()
    assert len(refused) >= 4, f"only with room for {[*refused]} KB was there an error"
    for message in refused.values():
        assert "No space left on device" in message
        assert str(small_disk / "runs") in message
    path = run_on(small_disk / "runs")
    assert rows_of(path) == rows_of(whole)
    assert evaluation_of(path) == evaluation_of(whole)
    assert not [p for p in path.rglob(".*") if p.name != ".lock"]
