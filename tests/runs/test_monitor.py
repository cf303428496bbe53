"""What ends a run, and what its rows say."""

from __future__ import annotations

import csv

import pytest

from gdrl_torchrl.config.schema import BudgetConfig
from gdrl_torchrl.runs.monitor import COLUMNS
from gdrl_torchrl.runs.phases import PHASES
from gdrl_torchrl.runs.run import run_experiment

NO_BUDGET = ("budget.agent_steps=null",)


@pytest.mark.usefixtures("without_figures")
class TestBudgets:
    def test_agent_steps_end_a_run_at_the_next_batch(self, tiny, evaluation_of):
        record = evaluation_of(run_experiment(tiny("budget.agent_steps=41")))
        assert record["agent_steps"] == 80

    def test_total_steps_count_those_of_the_population(self, tiny, rows_of):
        rows = rows_of(
            run_experiment(tiny(*NO_BUDGET, "budget.total_steps=150", "budget.wall_s=60"))
        )
        totals = [int(row["total_steps"]) for row in rows]
        assert totals[-1] >= 150
        assert all(total < 150 for total in totals[:-1])
        assert int(rows[-1]["population_steps"]) > 0

    def test_seconds_end_a_run(self, tiny, evaluation_of):
        path = run_experiment(tiny(*NO_BUDGET, "budget.wall_s=0.4"))
        with open(path / "metrics.csv", newline="") as file:
            clock = [float(row["wall_s"]) for row in csv.DictReader(file)]
        assert clock == sorted(clock)
        assert clock[-1] >= 0.4
        assert all(seconds < 0.4 for seconds in clock[:-1])
        assert evaluation_of(path)["wall_s"] >= 0.4

    def test_rows_add_up(self, tiny, rows_of):
        path = run_experiment(tiny("budget.agent_steps=240"))
        header = (path / "metrics.csv").read_text().splitlines()[0]
        losses = ("loss_objective", "loss_critic", "grad_norm")
        measures = ("kl_approx", "clip_fraction", "explained_variance", "entropy")
        assert header == ",".join((*COLUMNS, *losses, *measures, *PHASES))
        rows = rows_of(path)
        evaluated = [row for row in rows if row["mut_p"] != ""]
        assert len(evaluated) == int(rows[-1]["evaluations"]) >= 2
        for row in rows:
            steps = int(row["agent_steps"]) + int(row["population_steps"])
            assert int(row["total_steps"]) == steps
        for row in evaluated:
            best, parent = float(row["fitness_best"]), float(row["fitness_parent"])
            assert 0.0 <= float(row["fitness_mean"]) <= best <= 2.0
            assert parent <= best
            assert row["switched"] == str(int(row["winner"] != "0"))
            assert float(row["mut_p"]) in (0.75, 0.4, 0.1)
        switches = sum(int(row["switched"]) for row in evaluated)
        assert switches == int(rows[-1]["switches"])
        assert {row["without_fitness"] for row in rows} == {"0"}
        episodes = [int(row["episodes"]) for row in rows]
        assert episodes == sorted(episodes)

    def test_checkpoints_are_few(self, tiny):
        few = ("checkpoint.interval_s=0", "checkpoint.keep=2", "budget.agent_steps=240")
        path = run_experiment(tiny(*few, "evolution=none"))
        names = sorted(entry.name for entry in (path / "checkpoints").iterdir())
        assert sum("200" in name for name in names) == 1, names
        assert sum("240" in name for name in names) == 1, names
        assert not any("160" in name for name in names), names


@pytest.mark.parametrize(
    ("limits", "spent"),
    [
        ({"agent_steps": 100}, True),
        ({"agent_steps": 101}, False),
        ({"total_steps": 300}, True),
        ({"total_steps": 301}, False),
        ({"wall_s": 2.0}, True),
        ({"wall_s": 2.1}, False),
        ({"agent_steps": 101, "total_steps": 301, "wall_s": 2.1}, False),
        ({"agent_steps": 101, "total_steps": 301, "wall_s": 1.9}, True),
    ],
)
def test_the_first_budget_that_is_reached_ends_training(limits, spent):
    counters = {"agent_steps": 100, "total_steps": 300, "wall_s": 2.0}
    assert BudgetConfig(**limits).is_spent(counters) == spent
