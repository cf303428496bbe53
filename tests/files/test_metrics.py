"""Reading what runs leave behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gdrl_torchrl.files.evaluation import read_evaluation
from gdrl_torchrl.files.metrics import read_metrics
from gdrl_torchrl.files.trajectories import read_trajectories


def test_blank_cells_become_nan(run_dir: Path) -> None:
    metrics = read_metrics(run_dir)

    assert metrics["total_steps"].tolist() == [100, 200, 700, 800, 1300, 1400]
    assert np.isnan(metrics["success_rate"][0])
    assert metrics["success_rate"][1:].tolist() == [0.0, 0.25, 0.5, 0.5, 1.0]
    assert np.flatnonzero(np.isfinite(metrics["switched"])).tolist() == [2, 4]
    assert all(column.dtype == np.float64 for column in metrics.values())


def test_last_row_cut_short_by_a_kill_is_read(run_dir: Path) -> None:
    with (run_dir / "metrics.csv").open("a") as file:
        file.write("1500,700")

    metrics = read_metrics(run_dir)

    assert metrics["total_steps"][-1] == 1500
    assert np.isnan(metrics["wall_s"][-1])


def test_table_without_rows_has_empty_columns(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("agent_steps,total_steps\n")

    metrics = read_metrics(tmp_path)

    assert {name: len(column) for name, column in metrics.items()} == {
        "agent_steps": 0,
        "total_steps": 0,
    }


def test_cell_that_is_no_number_names_column_and_line(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("agent_steps,wall_s\n1,2\n3,four\n")

    with pytest.raises(ValueError, match=r"wall_s in line 3 .* 'four' is not a number"):
        read_metrics(tmp_path)


def test_evaluation_is_read(run_dir: Path) -> None:
    assert read_evaluation(run_dir)["success_rate"] == 0.95


@pytest.mark.parametrize("recorded", ["trajectories", "arena_trajectories"])
def test_trajectories_are_read(
    tmp_path: Path, recorded: str, request: pytest.FixtureRequest
) -> None:
    trajectories = request.getfixturevalue(recorded)
    np.savez(tmp_path / "trajectories.npz", allow_pickle=False, **trajectories)

    read = read_trajectories(tmp_path)

    assert read.keys() == trajectories.keys()
    for name, value in trajectories.items():
        np.testing.assert_array_equal(read[name], value)
