"""What a run does when numbers are no longer numbers, and what is kept of it."""

from __future__ import annotations

import csv
import itertools
import json
import os

import numpy as np
import pytest
import torch

from gdrl_tasks.engines.batch import BatchSimulation
from gdrl_torchrl.cli.replay import main, replay
from gdrl_torchrl.fast.loss import TracedLoss
from gdrl_torchrl.files.state import write_state
from gdrl_torchrl.runs.run import TrainingDivergedError, run_experiment
from tests.marks import full_but, gppo_is_quick, grainbow_is_quick

pytestmark = pytest.mark.usefixtures("without_figures")
EVERY = "checkpoint.interval_s=0"


def break_loss(losses, parameters):
    name = next(name for name in map(str, losses.keys()) if name.startswith("loss"))
    losses[name] = torch.tensor(torch.nan)


def break_gradient(losses, parameters):
    parameters[0].grad[0] = torch.inf


def break_parameter(losses, parameters):
    with torch.no_grad():
        parameters[0][0] = torch.nan


BREAKS = {
    "loss": break_loss,
    "gradient of ": break_gradient,
    "params": break_parameter,
}


@pytest.fixture
def broken_at(monkeypatch):
    """Makes something of the n-th update not finite, counted from now."""

    def breaks(number, spoil):
        backward, count = TracedLoss.backward, itertools.count(1)

        def backward_and_spoil(loss, batch):
            losses = backward(loss, batch)
            if next(count) == number:
                batch.set("from_test", torch.full(batch.batch_size, torch.nan))
                spoil(losses, loss.parameters)
            return losses

        monkeypatch.setattr(TracedLoss, "backward", backward_and_spoil)

    return breaks


@pytest.fixture
def injured_at(monkeypatch):
    """Makes the state of the first stepped world bad at the n-th step from now."""

    def injures(*numbers):
        step, count = BatchSimulation.step, itertools.count(1)

        def step_injured(simulation, action, ids=None):
            if next(count) in numbers:
                first = 0 if ids is None else ids[0]
                simulation.qvel[first, 0] = np.inf
            return step(simulation, action, ids)

        monkeypatch.setattr(BatchSimulation, "step", step_injured)

    return injures


def column(path, name):
    with open(path / "metrics.csv", newline="") as file:
        return [int(row[name]) for row in csv.DictReader(file)]


def tensors_of(state):
    """All tensors in nested dicts, lists and tuples."""
    if isinstance(state, torch.Tensor):
        return [state]
    if isinstance(state, np.ndarray):
        return [torch.from_numpy(state)]
    if isinstance(state, (list, tuple)):
        return [x for item in state for x in tensors_of(item)]
    return tensors_of(list(state.values())) if isinstance(state, dict) else []


def without_clock(record):
    return {name: value for name, value in record.items() if name != "wall_s"}


@grainbow_is_quick
def test_a_loss_that_is_not_finite_ends_training_and_nothing_is_lost(
    tiny_of_each, broken_at, evaluation_of, monkeypatch, whole_of
):
    whole = whole_of(tiny_of_each())
    backward = TracedLoss.backward
    broken_at(4, break_loss)
    with pytest.raises(TrainingDivergedError, match=r"not finite.*loss") as stop:
        run_experiment(tiny_of_each(EVERY))
    error = stop.value
    assert error.checkpoint is not None
    assert error.checkpoint.name in str(error)
    assert str(error.batch) in str(error)
    assert "not finite" in json.loads((error.path / "FAILED").read_text())["error"]
    # From the last good checkpoint, as if nothing had been.
    monkeypatch.setattr(TracedLoss, "backward", backward)
    resumed = run_experiment(tiny_of_each(EVERY))
    assert resumed == error.path
    assert not (resumed / "FAILED").exists()
    assert without_clock(evaluation_of(resumed)) == without_clock(evaluation_of(whole))


@pytest.mark.parametrize("what", BREAKS)
def test_the_minibatch_is_kept_and_what_is_not_finite_is_named(what, tiny, broken_at):
    broken_at(1, BREAKS[what])
    with pytest.raises(
        TrainingDivergedError, match=f"not finite.*{what}.*none yet"
    ) as stop:
        run_experiment(tiny())
    found = replay(stop.value.batch, [])
    assert any(what in name for name in found["not_finite"])
    assert found["numbers_not_finite"] == {"from_test": found["rows"]}
    assert found["entries"]["observation"][0] == found["rows"]


@pytest.mark.parametrize("what", full_but(["gradient of "], ["loss", "gradient of "]))
@gppo_is_quick
def test_such_updates_can_be_skipped(what, tiny_of_each, broken_at, evaluation_of):
    broken_at(2, BREAKS[what])
    path = run_experiment(tiny_of_each("faults.on_non_finite_update=skip"))
    assert column(path, "skipped_updates")[-1] == 1
    assert np.isfinite(evaluation_of(path)["return_mean"])
    assert not (path / "faults").exists()


def test_a_parameter_that_is_not_finite_is_never_skipped(tiny_of_each, broken_at):
    broken_at(2, break_parameter)
    with pytest.raises(TrainingDivergedError):
        run_experiment(tiny_of_each("faults.on_non_finite_update=skip"))


def test_a_skipped_update_changes_nothing(tiny_rainbow, broken_at):
    """Neither weights nor moments nor priorities."""
    from gdrl_torchrl.agents.rainbow.replay import draw_minibatch
    from gdrl_torchrl.runs.build import build_training
    from gdrl_torchrl.runs.checkpoint import seed_everything

    config = tiny_rainbow("faults.on_non_finite_update=skip")
    seed_everything(0)
    training = build_training(config)
    learner = training.agent.learner
    for batch in itertools.islice(training.agent.collector, 3):
        learner.store(batch)
    minibatch = draw_minibatch(learner.buffer)

    def state():
        optimizer = training.agent.optimizer.state_dict()["state"]
        moments = [x for values in optimizer.values() for x in values.values()]
        weights = list(training.agent.loss.state_dict().values())
        # The buffer with its priorities.
        kept = tensors_of(learner.state_dict()["buffer"])
        return [x.clone() for x in (*weights, *moments, *kept)]

    learner.step(minibatch)
    before = state()
    broken_at(1, break_gradient)
    learner.step(minibatch)
    after = state()
    assert len(before) == len(after)
    for one, other in zip(before, after, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    learner.step(minibatch)
    assert any(not torch.equal(x, y) for x, y in zip(before, state(), strict=True))
    training.close()


@pytest.fixture
def task_that_gives(monkeypatch):
    """Makes a task give a number that is none, to the last world, from a row on."""

    def gives(field, value, steps):
        step, count = BatchSimulation.step, itertools.count(1)

        def step_and_spoil(worlds, *arguments):
            result = step(worlds, *arguments)
            if worlds.num_worlds == 4 and next(count) > steps:
                getattr(result, field)[-1] = value
            return result

        monkeypatch.setattr(BatchSimulation, "step", step_and_spoil)

    return gives


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("reward", -np.inf),
        pytest.param("observation", np.nan, marks=pytest.mark.full),
    ],
)
@gppo_is_quick
def test_a_task_that_gives_no_number_is_named_before_anything_is_learnt_from_it(
    field, value, tiny_of_each, task_that_gives, monkeypatch, evaluation_of, whole_of
):
    whole = whole_of(tiny_of_each())
    config = tiny_of_each(EVERY)
    task_that_gives(field, value, 25)
    with pytest.raises(TrainingDivergedError) as stop:
        run_experiment(config)
    said = str(stop.value)
    assert f"{field}={value} of world 3, in its step " in said
    assert "must be finite" in said
    assert "episode_seed=" in said
    # The task is mended; figures are drawn from now on.
    monkeypatch.undo()
    told = replay(stop.value.batch, [])
    assert told["kind"] == "update"
    assert any(field in name for name in told["numbers_not_finite"])
    assert run_experiment(config) == stop.value.path
    mine, other = evaluation_of(stop.value.path), evaluation_of(whole)
    assert mine["params_sha256"] == other["params_sha256"]


@gppo_is_quick
def test_worlds_that_diverge_are_counted_and_some_can_be_replayed(
    tiny_of_each, injured_at, capsys, monkeypatch
):
    # The agent makes ten steps a batch; then its population is stepped.
    injured_at(*range(3, 400, 7))
    path = run_experiment(tiny_of_each("faults.most_files=3"))
    counted = column(path, "diverged")
    assert counted == sorted(counted)
    assert counted[0] >= 1
    assert counted[-1] > 3
    files = sorted((path / "faults").iterdir())
    assert len(files) == 3
    for file in files:
        found = replay(file, [])
        assert found["kind"] == "diverged_world"
        assert found["diverges_again"]
        assert found["outcome"] == "diverged"
        assert found["qvel_before"][0] == np.inf
        assert file.name == (
            f"diverged_{found['episode_seed']}_{found['steps_before']}.safetensors"
        )
    capsys.readouterr()
    monkeypatch.setattr("sys.argv", ["gdrl-replay", str(files[0]), "task.step_limit=30"])
    main()
    printed = json.loads(capsys.readouterr().out)
    assert printed["diverges_again"]
    assert printed["overrides"] == ["task.step_limit=30"]


STEP = {"before": {}, "action": [0.0]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "one file must be given"),
        (["one", "two"], "one two: one file must be given"),
        (["missing"], "missing must be a file"),
        (["text"], "text is damaged"),
        (["other"], "other is not a file about a fault"),
        (["unknown"], "kind='cake' must be one of"),
        (["world"], "world is damaged"),
        (["update", "task.sea=calm"], "an update has no task"),
        (["foreign"], r"must hold no \$"),
        (["pipe"], "pipe must be a file"),
        (["sparse"], "sparse has 6442450944 bytes, the most are"),
        (["folder"], "folder must be a file"),
    ],
)
def test_what_cannot_be_replayed_is_said(arguments, message, tmp_path, capsys, monkeypatch):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "sparse").touch()
    os.truncate(tmp_path / "sparse", 6 * 2**30)
    task = {"name": "water", "sea": "${oc.env:HOME}"}
    write_state(tmp_path / "foreign", {"kind": "diverged_world", "task": task} | STEP)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text").write_text("no safetensors")
    write_state(tmp_path / "other", [1, 2])
    write_state(tmp_path / "unknown", {"kind": "cake"})
    write_state(tmp_path / "world", {"kind": "diverged_world", "task": {}})
    write_state(tmp_path / "update", {"kind": "update"})
    monkeypatch.setattr("sys.argv", ["gdrl-replay", *arguments])
    with pytest.raises(SystemExit, match=f"error: .*{message}"):
        main()
