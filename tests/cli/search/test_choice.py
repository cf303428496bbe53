"""Searches: what they try, and when they give up on it."""

from __future__ import annotations

import pytest

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.cli.trials.search import search_table
from tests.cli.search.fake_runs import BEST_MUT_V, FakeRuns, search_of
from tests.marks import full_but


@pytest.mark.parametrize("storage", full_but(["journal"], ["journal", "sqlite"]))
def test_the_best_trial_is_the_one_with_the_highest_mean_over_seeds(tmp_path, storage):
    search, runs = search_of(tmp_path, seeds=[0, 3], storage=storage)
    search.optimize()
    values = [experiment.evolution.mut_v for experiment in runs.experiments]
    assert values[::2] == values[1::2]
    assert [experiment.seed for experiment in runs.experiments] == [0, 3] * 6
    nearest = min(values, key=lambda value: abs(value - BEST_MUT_V))
    best = search.best()
    assert best.user_attrs["overrides"] == [f"evolution.mut_v={nearest:.4g}"]
    expected = 1.0 - abs(nearest - BEST_MUT_V) - 0.015
    assert best.value == pytest.approx(expected, abs=1e-4)
    assert search_table(search).splitlines()[0].startswith(f"{best.value:.3f}  complete")


@pytest.mark.full
def test_trials_differ_and_come_nearer_than_chance(tmp_path):
    search, runs = search_of(tmp_path, num_trials=24)
    search.optimize()
    values = [experiment.evolution.mut_v for experiment in runs.experiments]
    assert len(set(values)) == 24
    # Of uniform draws a tenth would be as near.
    assert sum(abs(value - BEST_MUT_V) < 0.05 for value in values[12:]) > 3


def test_a_bad_trial_ends_early_and_a_good_one_gets_every_budget(tmp_path):
    search, runs = search_of(tmp_path, num_trials=8, total_steps=[1000, 2000, 3000])
    search.optimize()
    budgets = {}
    for experiment in runs.experiments:
        value = experiment.evolution.mut_v
        budgets.setdefault(value, []).append(experiment.budget.total_steps)
    assert all(found == [1000, 2000, 3000][: len(found)] for found in budgets.values())
    states = [trial.state.name for trial in search.finished()]
    assert states.count("PRUNED") == sum(len(found) < 3 for found in budgets.values()) > 0
    best = max(budgets, key=lambda value: -abs(value - BEST_MUT_V))
    assert budgets[best] == [1000, 2000, 3000]
    # The first five are never ended: there is no median to be worse than.
    assert all(len(found) == 3 for found in list(budgets.values())[:5])


def test_settings_that_were_tried_are_not_tried_again(tmp_path, caplog):
    """Nor do they count: a search has as many different trials as it says."""
    params = {
        "evolution.num_children": "choice(5, 10, 20)",
        "evolution.period_episodes": "choice(25, 50)",
    }
    fake = FakeRuns(tmp_path / "fake", rate=lambda e: e.evolution.num_children / 20)
    search, runs = search_of(tmp_path, fake, params=params, num_trials=5)
    search.optimize()
    settings = [
        (e.evolution.num_children, e.evolution.period_episodes) for e in runs.experiments
    ]
    assert len(search.finished()) == len(set(settings)) == len(settings) == 5
    # There are six of them, and then nothing is left to try.
    more, runs = search_of(tmp_path, fake, params=params, num_trials=9)
    more.optimize()
    assert len(more.finished()) == len(runs.experiments) == 6
    assert "every choice that is left was tried: 6 trials" in caplog.text
    assert "repeats" not in search_table(more)


def test_worlds_that_decide_are_not_those_of_reports(tmp_path):
    search, runs = search_of(tmp_path, num_trials=1)
    search.optimize()
    (experiment,) = runs.experiments
    assert experiment.evaluation.seed != load_experiment([]).evaluation.seed
    assert experiment.evaluation.episodes == 200
    assert experiment.budget.agent_steps is None


@pytest.mark.full
def test_choices_ranges_and_whole_numbers_stay_what_they_are(tmp_path):
    params = {
        "evolution.num_children": "choice(5, 10)",
        "evolution.num_trials": "range(2, 8, step=3)",
        "evolution.period_episodes": "int(interval(20000, 50000))",
        "evolution.mut_v": "tag(log, interval(0.001, 1.0))",
    }
    runs = FakeRuns(tmp_path / "fake", rate=lambda experiment: 0.5)
    search, runs = search_of(tmp_path, runs, params=params, num_trials=10)
    search.optimize()
    evolutions = [experiment.evolution for experiment in runs.experiments]
    assert {e.num_children for e in evolutions} == {5, 10}
    assert {e.num_trials for e in evolutions} == {2, 5}
    assert all(20_000 <= e.period_episodes <= 50_000 for e in evolutions)
    assert any(e.period_episodes % 100 for e in evolutions)
    # Half of logarithmic draws are below the middle of the exponents.
    assert 1 < sum(e.mut_v < 0.0316 for e in evolutions) < 9
