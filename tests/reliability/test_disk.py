"""A disk that is full, at whatever point of a run."""

from __future__ import annotations

import pytest

from gdrl_torchrl.analysis import figures
from gdrl_torchrl.cli.compose import load_experiment
from gdrl_torchrl.training.run import run_experiment
from gdrl_torchrl.training.run_directory import RunDirectoryError

ROOM_KB = (0, 4, 12, 24, 48, 100, 160, 240, 400)
"""Room that a run finds: for nothing at all, up to most of it."""


@pytest.fixture
def run_on(options_of, monkeypatch):
    for name in ("draw_learning_curve", "draw_trajectories"):
        monkeypatch.setattr(figures, name, lambda path: None)

    def run(folder):
        small = ["budget.agent_steps=400", "checkpoint.interval_s=0"]
        options = [*options_of("gppo_water"), *small, f"runs_dir={folder}"]
        return run_experiment(load_experiment(options))

    return run


def test_a_full_disk_is_named_and_nothing_that_was_saved_is_lost(
    small_disk, leave_room, run_on, tmp_path, rows_of, evaluation_of
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
