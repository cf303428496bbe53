"""Arguments of ``gdrl-evaluate`` are checked, and their errors name them."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

from gdrl_torchrl.agents.registry import make_actor
from gdrl_torchrl.cli.evaluate import evaluate_run
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.config.task import make_task_from_config
from gdrl_torchrl.files.policy import save_policy


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """As much of a run directory as an evaluation reads."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("run")
    config = load_experiment(
        ["task.step_limit=4", "evaluation.episodes=3", "evaluation.num_worlds=2"]
    )
    (path / "config.json").write_text(json.dumps(dataclasses.asdict(config)))
    task = make_task_from_config(config.task)
    save_policy(
        path / "final",
        make_actor(task, config.network, config.algorithm),
        task,
        config.algorithm_label,
    )
    return path


def test_task_and_episodes_can_be_others(run):
    result = evaluate_run(
        [f"run={run}", "episodes=5", "seed=2", "task.sea=rough", "task.step_limit=6"]
    )
    assert result["overrides"] == ["task.sea=rough", "task.step_limit=6"]
    assert (result["episodes"], result["seed"]) == (5, 2)
    assert result["steps_mean"] == 6.0
    assert evaluate_run([f"run={run}"])["steps_mean"] == 4.0


def test_a_damaged_configuration_is_named(tmp_path):
    (tmp_path / "config.json").write_text('{"task": ')
    with pytest.raises(ValueError, match=r"config\.json"):
        evaluate_run([f"run={tmp_path}"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "run=<run directory> must be given"),
        (["episodes=3"], "run=<run directory> must be given"),
        (["{path}"], "must be given as run="),
        (["run={path}", "episode=3"], "did you mean episodes=...?"),
        (["run={path}", "fuel=1"], "fuel=1"),
        (["run={path}", "episodes"], "episodes"),
        (["run={path}", "episodes=0"], "episodes=0"),
        (["run={path}", "episodes=-2"], "episodes=-2"),
        (["run={path}", "episodes=many"], "episodes=many must be a whole number >= 1"),
        (["run={path}", "seed=-1"], "seed=-1"),
        (["run={path}", "seed=1.5"], "seed=1.5 must be a whole number >= 0"),
        (["run={path}", "task.sea=stormy"], "sea='stormy'"),
        (["run={path}", "episodes=2k"], "write 2_000"),
        (["run={path}", "task.fuel=1"], "task.fuel=1 must be an option that exists"),
        (["run={path}", "task.see=calm"], "did you mean task.sea?"),
        (["run={path}", "task.sea=["], "task.sea=[ must be name=value"),
        (["run={path}", "task.sea.x=1"], "task.sea.x=1 must be one of"),
        (
            ["run={path}", "task.step_limit=many"],
            "task.step_limit=many must be a",
        ),
        (["run={path}", "task.actions=discrete"], "actions"),
        (["run={path}", "task.extra_observations=[roll]"], "extra_observations"),
        (["run=elsewhere"], "run=elsewhere"),
    ],
)
def test_bad_arguments_of_an_evaluation_are_named(arguments, said, run):
    with pytest.raises(ValueError, match=r".") as refused:
        evaluate_run([argument.format(path=run) for argument in arguments])
    assert said in str(refused.value)
