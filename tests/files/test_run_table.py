"""The table of runs: states, filters and text."""

from __future__ import annotations

import fcntl
import json
import shutil

import pytest

from gdrl_torchrl.cli.runs import list_runs, main
from gdrl_torchrl.files.run_table import (
    find_runs,
    format_table,
    run_row,
    select_runs,
    state_of,
)

METRICS = "agent_steps,total_steps,success_rate,wall_s\n40,60,0.25,1.5\n80,120,,3.0\n"


@pytest.fixture
def make(tmp_path):
    """Makes a run directory with the files that belong to a state."""

    def make_run(state, *, seed=0, metrics=METRICS, **task):
        run = tmp_path / "smoke" / "0a1b2c3d" / f"seed_{seed}"
        run.mkdir(parents=True)
        config = {"name": "smoke", "seed": seed, "task": {"name": "water"} | task}
        config["algorithm"] = {"name": "ppo"}
        config["evolution"] = {"name": "genetic", "enabled": True}
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


def test_a_run_is_what_its_configuration_says_wherever_it_was_copied(make, tmp_path):
    run = make("done")
    copy = tmp_path / "elsewhere" / "copy"
    shutil.copytree(run, copy)
    assert run_row(copy)["algorithm"] == run_row(run)["algorithm"] == "gppo"
    # As runs were laid out before.
    old = tmp_path / "smoke" / "water" / "gppo" / "0a1b2c3d" / "seed_0"
    shutil.copytree(run, old)
    assert find_runs(tmp_path) == [copy, run, old]
    assert run_row(old)["algorithm"] == "gppo"


@pytest.mark.parametrize(
    "wanted",
    [
        {"algorithm": "gppo"},
        {"algorithm.name": "gppo"},
        {"algorithm.name": "ppo"},
        {"task": "water"},
        {"task.name": "water"},
        {"name": "smoke"},
    ],
)
def test_runs_are_selected_by_what_the_columns_say(wanted, make):
    run = make("done")
    assert select_runs([run], wanted) == [run]
    assert select_runs([run], dict.fromkeys(wanted, "other")) == []


def test_a_misspelt_option_is_answered_with_the_nearest(make):
    run = make("done", sea="calm")
    with pytest.raises(
        ValueError, match=r"task\.see=calm must .* did you mean task\.sea\?"
    ):
        select_runs([run], {"task.see": "calm"})


def test_an_empty_table_says_what_there_is(make, tmp_path, capsys):
    make("done", sea="calm")
    lines = list_runs([str(tmp_path), "task.sea=rough"]).splitlines()
    assert len(lines) == 1
    assert "no run has task.sea=rough, but calm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "one folder must be given"),
        (["state=done"], "one folder must be given"),
        (["{here}", "done"], "one folder must be given"),
        (["{here}/nothing"], "nothing must be a folder"),
        (["{here}", "state=over"], "state=over must be one of done, "),
    ],
)
def test_bad_arguments_are_answered_with_what_must_be_given(arguments, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        list_runs([argument.format(here=tmp_path) for argument in arguments])


def test_names_of_folders_cannot_command_a_terminal(make, tmp_path, capsys, monkeypatch):
    make("done")
    evil = tmp_path / "\x1b[31mred\x07"
    (tmp_path / "smoke").rename(evil)
    (damaged,) = find_runs(evil)
    (damaged / "config.json").write_text("{")
    monkeypatch.setattr("sys.argv", ["gdrl-runs", str(evil)])
    with pytest.raises(SystemExit) as end:
        main()
    told = str(end.value) + capsys.readouterr().out
    assert "config.json is not valid JSON" in told
    assert "red" in told
    assert not any(sign in told for sign in ("\x1b", "\x07"))
    monkeypatch.setattr("sys.argv", ["gdrl-runs", str(evil / "nothing")])
    with pytest.raises(SystemExit) as end:
        main()
    assert "must be a folder" in str(end.value)
    assert "\x1b" not in str(end.value)


def test_the_command_lists_what_it_finds(make, tmp_path):
    make("done"), make("failed", seed=1)
    lines = list_runs([str(tmp_path), "state=failed"]).splitlines()
    assert len(lines) == 2
    assert lines[1].startswith("failed")
