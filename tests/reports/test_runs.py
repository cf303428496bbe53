"""Reports on run directories that no study has made."""

from __future__ import annotations

import numpy as np
import pytest

from gdrl_torchrl.reports.of_runs import runs_evidence
from gdrl_torchrl.reports.report import write_report
from tests.reports.invented import write_run


@pytest.fixture
def runs(tmp_path):
    rng = np.random.default_rng(1)
    for algorithm, level in (("ppo", 0.5), ("gppo", 0.8)):
        for seed in range(4):
            success = float(np.clip(level + 0.1 * rng.standard_normal(), 0.0, 1.0))
            write_run(tmp_path, "water", algorithm, seed, round(success, 3))
    return tmp_path


def methods(evidence):
    return [(arm.task, arm.method, len(arm.runs)) for arm in evidence.arms]


def test_runs_are_grouped_by_task_and_algorithm(runs):
    assert methods(runs_evidence(runs)) == [("water", "gppo", 4), ("water", "ppo", 4)]


def test_the_page_of_runs_has_scores_and_curves_and_no_tests(runs, tmp_path):
    page = write_report(runs_evidence(runs), tmp_path / "report").read_text()
    assert 'id="scores"' in page
    assert 'id="curves-0-total_steps"' in page
    assert "hypotheses" not in page.replace("registered hypotheses", "")


def test_configurations_of_one_algorithm_are_methods_of_their_own(tmp_path):
    for key in ("aaaa0001", "aaaa0002"):
        run = write_run(tmp_path, "water", "ppo", 0, 0.5)
        run.parent.rename(tmp_path / "trial" / key)
    assert methods(runs_evidence(tmp_path)) == [
        ("water", "ppo trial aaaa0001", 1),
        ("water", "ppo trial aaaa0002", 1),
    ]


def test_experiments_of_one_algorithm_are_told_apart_by_name(tmp_path):
    for name in ("small", "large"):
        write_run(tmp_path, "water", "ppo", 0, 0.5, name=name)
    assert [m for _, m, _ in methods(runs_evidence(tmp_path))] == ["ppo large", "ppo small"]


def test_one_algorithm_on_two_tasks_is_one_method(tmp_path):
    write_run(tmp_path, "water", "ppo", 0, 0.5, name="ppo_water")
    write_run(tmp_path, "indoor", "ppo", 0, 0.5, name="ppo_indoor")
    assert methods(runs_evidence(tmp_path)) == [("indoor", "ppo", 1), ("water", "ppo", 1)]


def test_a_run_that_failed_counts_as_zero(runs):
    write_run(runs, "water", "ppo", 9, 0.9, state="failed")
    evidence = runs_evidence(runs)
    assert evidence.arm("water", "ppo").scores[-1] == 0.0
    assert evidence.arm("water", "ppo").runs[-1].failed


def test_runs_that_go_on_or_are_damaged_are_left_out_and_named(runs):
    write_run(runs, "water", "ppo", 10, 0.9, state="stopped")
    damaged = write_run(runs, "water", "ppo", 11, 0.9)
    (damaged / "evaluation.json").write_text("{")
    evidence = runs_evidence(runs)
    assert len(evidence.arm("water", "ppo").runs) == 4
    told = " ".join(evidence.remarks)
    assert "Left out, runs that were interrupted: 1." in told
    assert "seed_11/evaluation.json is not valid JSON" in told
    assert str(runs) not in told


def test_a_copy_of_a_run_is_no_further_evidence(runs):
    write_run(runs / "copy", "water", "ppo", 0, 0.5)
    evidence = runs_evidence(runs)
    assert len(evidence.arm("water", "ppo").runs) == 4
    assert "Left out, copies of other runs here: 1." in evidence.remarks


def test_a_long_table_of_metrics_is_thinned_out(runs):
    run = write_run(runs, "water", "ppo", 12, 0.5)
    head = (run / "metrics.csv").read_text().splitlines()[0]
    many = [f"{k},{k},{k},{k},0.5,0,0" for k in range(1, 5001)]
    (run / "metrics.csv").write_text("\n".join([head, *many]) + "\n")
    curve = runs_evidence(runs).arm("water", "ppo").runs[-1].curve
    assert len(curve["total_steps"]) <= 200
    assert curve["total_steps"][[0, -1]].tolist() == [1.0, 5000.0]
