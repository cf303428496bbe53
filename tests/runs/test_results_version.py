"""A change of what runs compute, or of the state they go on from, raises their version.

``results.json`` has, by version, ``params_sha256`` of tiny runs and a digest of the names
of what their checkpoints hold; and what they were made with, for other packages, or
another processor, may sum in another order.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
import torch

from gdrl_torchrl.runs.build import build_training
from gdrl_torchrl.runs.checkpoint import TrainingState, seed_everything
from gdrl_torchrl.runs.place import RUN_VERSION, provenance
from gdrl_torchrl.runs.run import run_experiment
from tests.small import compose, small_options

pytestmark = pytest.mark.usefixtures("without_figures")

FILE = Path(__file__).with_name("results.json")
EXPERIMENTS = {
    # With normalised advantages: choosing other settings is no change of what they compute.
    "gppo_water": ["algorithm=ppo"],
    "grainbow_indoor": [],
    "ga_water": [],
    "erl_indoor": [],
    "paired_water": ["algorithm=ppo"],
}


def made_with():
    instructions = torch.backends.cpu.get_cpu_capability()
    return provenance()["packages"] | {"processor": instructions}


class NoCounters:
    def state_dict(self):
        return {}


def names_in(state):
    """What a state holds, without values: how many there are may depend on the options."""
    if isinstance(state, dict):
        return {str(name): names_in(value) for name, value in sorted(state.items())}
    return type(state).__name__


def state_digest(config):
    seed_everything(0)
    training = build_training(config)
    try:
        state = TrainingState(training, NoCounters()).state_dict()
    finally:
        training.close()
    text = json.dumps(names_in(state), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def recorded():
    content = json.loads(FILE.read_text())
    return content["made_with"], content["versions"].get(str(RUN_VERSION), {})


@pytest.fixture
def small(tmp_path):
    def make(experiment):
        total = 1200 if experiment.startswith("ga_") else "null"
        return compose(
            [
                *small_options(experiment),
                *EXPERIMENTS[experiment],
                "logger.tensorboard=false",
                "simulation.num_threads=1",
                f"budget.total_steps={total}",
                "budget.agent_steps=320",
                f"runs_dir={tmp_path / 'runs'}",
            ]
        )

    return make


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_what_runs_compute_and_keep_is_that_of_their_version(
    experiment, small, evaluation_of
):
    with_what, versions = recorded()
    config = small(experiment)
    found = {"state": state_digest(config)}
    known = versions.get(experiment, {})
    advice = (
        f"raise RUN_VERSION in runs/place.py and put what is found below its "
        f"number into {FILE.name}"
    )
    assert known.get("state") == found["state"], f"state {found}: {advice}"
    record = evaluation_of(run_experiment(config))
    if with_what != made_with():
        pytest.skip(f"hashes are of {with_what}, this is {made_with()}")
    found["params_sha256"] = record["params_sha256"]
    assert known == found, f"results {found}: {advice}"
