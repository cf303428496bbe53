"""Small parts that several test folders share."""

from __future__ import annotations

import copy
import csv
import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded, Categorical, TensorSpec
from torchrl.modules import (
    MLP,
    Actor,
    DistributionalQValueActor,
    QValueActor,
)
from torchrl.modules.models.models import DuelingMlpDQNet

from gdrl_tasks import make_task
from gdrl_torchrl.agents.networks import make_tanh_normal_actor
from gdrl_torchrl.evolution.operators.genome import concatenate, genome_of, stack_copies
from gdrl_torchrl.evolution.operators.mutation import bernoulli_mutation
from gdrl_torchrl.pictures import figures
from gdrl_torchrl.runs.phases import PHASES
from tests.small import EASY_WATER, compose, tiny_options

CONTINUOUS = ("deterministic", "sequential", "tanh_normal")
DISCRETE = ("q_value", "distributional")
NUM_ATOMS = 11
CLOCK = ("wall_s", *PHASES)


def _dueling(size: int, actions: int) -> nn.Module:
    return DuelingMlpDQNet(
        out_features=(NUM_ATOMS, actions),
        out_features_value=(NUM_ATOMS, 1),
        mlp_kwargs_feature={"in_features": size, "num_cells": [8], "out_features": 8},
        mlp_kwargs_output={"in_features": 8, "num_cells": 8},
    )


def make_actor(
    kind: str, observation_size: int = 3, spec: TensorSpec | None = None
) -> nn.Module:
    """An actor of a kind with a small network, its weights from the global generator."""
    if spec is None:
        continuous = kind in CONTINUOUS
        spec = Bounded(-1.0, 1.0, shape=(2,)) if continuous else Categorical(7)
    actions = spec.space.n if kind in DISCRETE else spec.shape[-1]
    sizes = {"in_features": observation_size, "num_cells": [8]}
    if kind == "deterministic":
        network = nn.Sequential(MLP(out_features=actions, **sizes), nn.Tanh())
        return Actor(network, in_keys=["observation"], spec=spec)
    if kind == "sequential":
        return TensorDictSequential(
            TensorDictModule(MLP(out_features=5, **sizes), ["observation"], ["hidden"]),
            TensorDictModule(MLP(in_features=5, out_features=2), ["hidden"], ["raw"]),
            TensorDictModule(nn.Tanh(), ["raw"], ["action"]),
        )
    if kind == "tanh_normal":
        return make_tanh_normal_actor(observation_size, spec, num_cells=(8,))
    if kind == "q_value":
        return QValueActor(
            MLP(out_features=actions, **sizes), in_keys=["observation"], spec=spec
        )
    return DistributionalQValueActor(
        _dueling(observation_size, actions),
        support=torch.linspace(-1.0, 1.0, NUM_ATOMS),
        in_keys=["observation"],
        spec=spec,
    )


def make_population(actor: nn.Module, size: int, *, std: float = 0.7) -> TensorDictBase:
    """A copy of the actor, then strongly mutated children, ``[size]``."""
    genome = genome_of(actor)
    if size == 1:
        return stack_copies(genome, 1)
    children = bernoulli_mutation(
        stack_copies(genome, size - 1),
        mut_p=1.0,
        std=std,
        generator=torch.Generator().manual_seed(1),
    )
    return concatenate([stack_copies(genome, 1), children])


def make_member(actor: nn.Module, population: TensorDictBase, number: int) -> nn.Module:
    """A deep copy of the actor with one member's weights: nothing of ours installs."""
    member = copy.deepcopy(actor)
    state = member.state_dict()
    for path, value in population[number].items(include_nested=True, leaves_only=True):
        state[path if isinstance(path, str) else ".".join(path)] = value.clone()
    member.load_state_dict(state)
    return member


@pytest.fixture(scope="session", autouse=True)
def _signals_as_of_a_terminal():
    """What started the tests may ignore signals, as nohup does: runs would do so too."""
    usual = {signal.SIGHUP: signal.SIG_DFL, signal.SIGINT: signal.default_int_handler}
    ignored = [n for n in usual if signal.getsignal(n) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, usual[number])
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture(params=[*CONTINUOUS, *DISCRETE])
def actor_kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def actor_of() -> Callable[..., nn.Module]:
    return make_actor


@pytest.fixture
def population_of() -> Callable[..., TensorDictBase]:
    return make_population


@pytest.fixture
def member_of() -> Callable[..., nn.Module]:
    return make_member


@pytest.fixture
def easy_task_for() -> Callable[..., object]:
    """Makes an easy task whose actions fit a kind of actor."""

    def make(kind: str = "tanh_normal", **options: object) -> object:
        actions = "discrete" if kind in DISCRETE else "continuous"
        easy = {**EASY_WATER, "reward": "dense", "step_limit": 24}
        return make_task("water", **easy | {"actions": actions} | options)

    return make


def _composer(experiment: str, runs_dir: Path, *base: str) -> Callable[..., object]:
    chosen = tiny_options(experiment, [*base, f"runs_dir={runs_dir}"])
    return lambda *overrides: compose([*chosen, *overrides])


@pytest.fixture
def tiny(tmp_path: Path) -> Callable[..., object]:
    """Composes a tiny configuration with further overrides: GPPO on the water."""
    return _composer("gppo_water", tmp_path / "runs")


@pytest.fixture
def tiny_rainbow(tmp_path: Path) -> Callable[..., object]:
    """The same for GRainbow indoors."""
    few = ("task.num_beams=5", "evolution.experience_share=0.5")
    return _composer("grainbow_indoor", tmp_path / "runs", *few)


@pytest.fixture(params=["tiny", "tiny_rainbow"], ids=["gppo", "grainbow"])
def tiny_of_each(request: pytest.FixtureRequest) -> Callable[..., object]:
    """The same for both, one after the other."""
    return request.getfixturevalue(request.param)


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs draw nothing: their figures have tests of their own."""
    for name in ("draw_learning_curve", "draw_trajectories"):
        monkeypatch.setattr(figures, name, lambda path: None)


@pytest.fixture
def rows_of() -> Callable[[Path], list[dict[str, str]]]:
    """Reads the rows of a run's metrics, without the clock."""

    def read(run: Path) -> list[dict[str, str]]:
        with (run / "metrics.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            for name in CLOCK:
                assert float(row.pop(name)) >= 0.0
        return rows

    return read


@pytest.fixture
def evaluation_of() -> Callable[[Path], dict[str, object]]:
    """Reads a run's evaluation."""
    return lambda run: json.loads((run / "evaluation.json").read_text())
