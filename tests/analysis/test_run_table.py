"""The table of runs: states, filters and text."""

from __future__ import annotations

import fcntl
import json

import pytest

from gdrl_torchrl.analysis.run_table import (
    find_runs,
    format_table,
    run_row,
    select_runs,
    state_of,
)
from gdrl_torchrl.cli.runs import list_runs

METRICS = "agent_steps,total_steps,success_rate,wall_s\n40,60,0.25,1.5\n80,120,,3.0\n"


@pytest.fixture
def make(tmp_path):
    """Makes a run directory with the files that belong to a state."""

    def make_run(state, *, seed=0, metrics=METRICS, **task):
        run = tmp_path / "smoke" / "water" / "gppo" / "0a1b2c3d" / f"seed_{seed}"
        run.mkdir(parents=True)
        config = {"name": "smoke", "seed": seed, "task": {"name": "water"} | task}
        (run / "config.json").write_text(json.dumps(config))
        (run / ".lock").touch()
        if metrics is not None:
            (run / "metrics.csv").write_text(metrics)
        if state == "done":
            result = {"success_rate": 0.75, "agent_steps": 100, "wall_s": 4.0}
            (run / "evaluation.json").write_text(json.dumps(result))
            (run / "DONE").write_text("{}")
        if state == "failed":
            (run / "FAILED").write_text("{}")
        return run

    return make_run


@pytest.mark.parametrize("state", ["done", "stopped", "failed"])
def test_states_are_told_by_the_files_that_a_run_left(state, make):
    assert state_of(make(state)) == state


def test_a_locked_run_is_running(make):
    run = make("done")
    with open(run / ".lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert state_of(run) == "running"
    assert state_of(run) == "done"


def test_a_row_has_the_evaluation_of_a_done_run_and_else_the_last_metrics(make):
    done, stopped = run_row(make("done")), run_row(make("stopped", seed=1))
    assert (done["success_rate"], done["agent_steps"], done["wall_s"]) == (0.75, 100, 4.0)
    assert (stopped["agent_steps"], stopped["total_steps"]) == (80, 120)
    assert (stopped["success_rate"], stopped["population_steps"]) == (None, None)
    assert stopped["algorithm"] == "gppo"


@pytest.mark.parametrize(
    "metrics", [None, "", "agent_steps,wall_s", "agent_steps,wall_s\n", METRICS + "90,1"]
)
def test_a_run_that_has_only_begun_has_a_row(metrics, make):
    row = run_row(make("stopped", metrics=metrics))
    assert row["agent_steps"] == (80 if metrics and "90,1" in metrics else None)


def test_runs_are_filtered_by_state_and_by_any_key(make, tmp_path):
    calm = make("done", seed=0, sea="calm", waves=3)
    rough = make("stopped", seed=1, sea="rough", waves=3)
    runs = find_runs(tmp_path)
    assert runs == [calm, rough]
    assert select_runs(runs, {"state": "done"}) == [calm]
    assert select_runs(runs, {"task.sea": "rough"}) == [rough]
    assert select_runs(runs, {"task.waves": "3", "seed": "1"}) == [rough]
    assert select_runs(runs, {"seed": "7"}) == []
    with pytest.raises(ValueError, match=r"task\.see"):
        select_runs(runs, {"task.see": "calm"})


def test_nothing_inside_a_run_is_looked_for(make, tmp_path):
    run = make("running")
    nested = run / "checkpoints" / "staged"
    nested.mkdir(parents=True)
    (nested / "config.json").write_text("{}")
    assert find_runs(tmp_path) == [run]
    assert find_runs(tmp_path / "nothing") == []


def test_the_table_is_aligned_and_has_dashes_where_nothing_is_known(make):
    rows = [run_row(make("done")), run_row(make("stopped", seed=1))]
    lines = format_table(rows, ("state", "success_rate", "wall_s")).splitlines()
    assert lines == [
        "state    success_rate  wall_s",
        "done     0.750         4.000",
        "stopped  -             3.000",
    ]


@pytest.mark.parametrize(
    "arguments", [[], ["state=done"], ["--help"], ["{here}", "done"], ["{here}/nothing"]]
)
def test_bad_arguments_are_answered_with_the_usage(arguments, tmp_path):
    with pytest.raises(ValueError, match="usage"):
        list_runs([argument.format(here=tmp_path) for argument in arguments])


def test_an_unknown_state_is_refused(tmp_path):
    with pytest.raises(ValueError, match="state='over'"):
        list_runs([str(tmp_path), "state=over"])


def test_the_command_lists_what_it_finds(make, tmp_path):
    make("done"), make("failed", seed=1)
    lines = list_runs([str(tmp_path), "state=failed"]).splitlines()
    assert len(lines) == 2
    assert lines[1].startswith("failed")
