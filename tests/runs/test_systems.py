"""Every way to evolve trains, counts its costs and can be resumed."""

from __future__ import annotations

import pytest

from gdrl_torchrl.runs import report, run
from gdrl_torchrl.runs.run import run_experiment
from tests.marks import full_but
from tests.small import compose, small_options

pytestmark = pytest.mark.usefixtures("without_figures")

SYSTEMS = {
    "ga_water": "ga",
    "erl_indoor": "erl_rainbow",
    "soft_indoor": "soft_rainbow",
    "safe_mutation_water": "safe_mutation_ppo",
    "crossover_water": "crossover_ppo",
    "n_point_indoor": "n_point_rainbow",
    "paired_water": "paired_ppo",
    "control_experience_indoor": "control_experience_rainbow",
    "control_random_indoor": "control_random_rainbow",
    "control_selection_water": "control_selection_ppo",
}
"""Each way to evolve once; beside them ``make test-full`` kills every experiment."""
QUICK = ("ga_water", "erl_indoor")
"""Of each kind of evolution one: no agent, a population beside it, children of it."""
PLAIN = [
    "logger.tensorboard=false",
    "simulation.num_threads=1",
    "checkpoint.interval_s=0",
]


@pytest.fixture
def small(tmp_path):
    def make(name, *overrides):
        runs = f"runs_dir={tmp_path / 'runs'}"
        return compose([*small_options(name), *PLAIN, runs, *overrides])

    return make


@pytest.mark.parametrize("name", full_but(QUICK, SYSTEMS))
def test_a_system_that_was_stopped_ends_where_one_that_was_not_does(
    name, small, rows_of, evaluation_of, tmp_path
):
    budgets = ["budget.agent_steps=120", "budget.agent_steps=240"]
    if SYSTEMS[name] == "ga":
        budgets = ["budget.total_steps=200", "budget.total_steps=400"]
    whole = run_experiment(small(name, budgets[1], f"runs_dir={tmp_path / 'whole'}"))
    for budget in budgets:
        stopped = run_experiment(small(name, budget))
    assert evaluation_of(stopped)["algorithm"] == SYSTEMS[name]
    assert rows_of(stopped) == rows_of(whole)
    one, other = evaluation_of(stopped), evaluation_of(whole)
    assert one.pop("wall_s") > 0.0
    other.pop("wall_s")
    assert one == other
    rows = rows_of(whole)
    assert one["algorithm"] == SYSTEMS[name]
    assert one["population_steps"] > 0
    assert one["total_steps"] == one["agent_steps"] + one["population_steps"]
    assert int(rows[-1]["evaluations"]) >= 2
    assert any(row["fitness_best"] for row in rows)
    assert (one["agent_steps"] == 0) == (SYSTEMS[name] == "ga")


@pytest.mark.parametrize("name", ["erl_water", "ga_indoor"])
def test_the_result_is_the_champion(name, small, monkeypatch):
    champions = []
    save = report.save_policy

    def save_and_note(folder, actor, task, algorithm):
        champions.append(actor)
        save(folder, actor, task, algorithm)

    monkeypatch.setattr(report, "save_policy", save_and_note)
    trained = []
    build = run.build_training

    def build_and_note(config, **watching):
        trained.append(build(config, **watching))
        return trained[0]

    monkeypatch.setattr(run, "build_training", build_and_note)
    run_experiment(small(name, "budget.total_steps=300", "budget.agent_steps=200"))
    champion = trained[0].evolution.final_genome()
    weights = dict(champions[0].named_parameters())
    for key in champion.keys(True, True):
        path = key if isinstance(key, str) else ".".join(key)
        assert (weights[path] == champion[key]).all()


def test_a_genetic_algorithm_beside_an_evolution_is_refused(small):
    with pytest.raises(ValueError, match="evolution=none"):
        run_experiment(small("ga_water", "evolution=genetic", "budget.total_steps=300"))


@pytest.mark.parametrize(
    ("name", "needed"), [("gppo_indoor", "discrete"), ("grainbow_water", "continuous")]
)
def test_an_impossible_pair_says_which_variant_to_choose(name, needed, small):
    other = {"discrete": "continuous", "continuous": "discrete"}[needed]
    with pytest.raises(ValueError, match=f"give task.actions={other}"):
        run_experiment(small(name, f"task.actions={needed}"))
