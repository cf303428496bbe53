"""What TensorBoard and ``metrics.csv`` show of a run, and of one that goes on."""

from __future__ import annotations

import csv
import io
import json

import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gdrl_torchrl.runs.phases import PHASES
from gdrl_torchrl.runs.place import directory_of
from gdrl_torchrl.runs.run import run_experiment
from tests.marks import grainbow_is_quick

SHOWN = "logger.tensorboard=true"
OF_UPDATES = {
    "ppo": {
        *("loss_objective", "loss_critic", "grad_norm", "entropy"),
        *("kl_approx", "clip_fraction", "explained_variance"),
    },
    "rainbow": {
        *("loss", "grad_norm", "q_mean", "clipped_mass"),
        *("priority_mean", "priority_max"),
    },
}


def table_of(path):
    with (path / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def events_of(path):
    events = EventAccumulator(str(path / "tensorboard"), {"images": 0, "scalars": 0})
    events.Reload()
    return events


@pytest.mark.slow
@grainbow_is_quick
def test_both_have_losses_measures_and_the_clock(tiny_of_each):
    config = tiny_of_each(SHOWN, "budget.agent_steps=240")
    path = run_experiment(config)
    rows, events = table_of(path), events_of(path)
    measures = OF_UPDATES[config.algorithm.name]
    shown = events.Tags()["scalars"]
    assert measures == {name[7:] for name in shown if name.startswith("update/")}
    last = rows[-1]
    for name in measures | set(PHASES):
        group = "update" if name in measures else "time"
        curve = events.Scalars(f"{group}/{name}")
        assert curve[-1].value == pytest.approx(float(last[name]), rel=1e-5, abs=1e-6)
        assert curve[-1].step == int(last["total_steps"])
    assert sum(float(row["evaluate_s"]) for row in rows) > 0.0
    phases = set(PHASES) - {"steps_per_s"}
    seconds = sum(float(row[name]) for row in rows for name in phases)
    assert seconds <= float(last["wall_s"]) + 0.1
    assert float(last["steps_per_s"]) > 0.0
    measured = [row for row in rows if row["grad_norm"]]
    assert all(float(row["grad_norm"]) > 0.0 for row in measured)
    assert len({row["grad_norm"] for row in measured}) == len(measured)


@pytest.mark.slow
def test_tensorboard_has_configuration_result_and_figures(tiny, evaluation_of):
    path = run_experiment(tiny(SHOWN, "algorithm.gamma=0.97"))
    events, record = events_of(path), evaluation_of(path)
    (text,) = events.Tensors("configuration/text_summary")[:1]
    assert '"gamma": 0.97' in text.tensor_proto.string_val[0].decode()
    for name in ("success_rate", "return_mean"):
        (result,) = events.Scalars(f"held_out/{name}")
        assert result.value == pytest.approx(record[name])
        assert result.step == record["total_steps"]
    for name in ("learning_curve", "trajectories"):
        (shown,) = events.Images(f"figures/{name}")
        with Image.open(io.BytesIO(shown.encoded_image_string)) as picture:
            assert picture.size == (shown.width, shown.height)
        file = path / "figures" / f"{name}.png"
        assert shown.encoded_image_string == file.read_bytes()


@pytest.mark.usefixtures("without_figures")
@pytest.mark.full
def test_a_table_of_fewer_columns_is_gone_on_with(tiny, rows_of):
    begun = run_experiment(tiny())
    old = ("total_steps", "agent_steps", "wall_s", "success_rate", "mut_p", "switched")
    rows = table_of(begun)
    with (begun / "metrics.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, old, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    config = tiny("budget.agent_steps=200")
    assert directory_of(config).path == begun
    run_experiment(config)
    now = table_of(begun)
    assert len(now) == 5
    assert [row["total_steps"] for row in now[:3]] == [row["total_steps"] for row in rows]
    assert all(row["grad_norm"] == "" for row in now[:3])
    assert all(float(row["grad_norm"]) > 0.0 for row in now[3:])
    assert json.loads((begun / "DONE").read_text())["costs"]["agent_steps"] == 200
