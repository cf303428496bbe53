"""Small parts that several test folders share."""

from __future__ import annotations

import copy
import signal
from collections.abc import Callable

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
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.evolution.operators.genome import concatenate, genome_of, stack_copies
from gdrl_torchrl.evolution.operators.mutation import bernoulli_mutation
from gdrl_torchrl.evolution.settings import ErlConfig

CONTINUOUS = ("deterministic", "sequential", "tanh_normal")
DISCRETE = ("q_value", "distributional")
NUM_ATOMS = 11

EASY = {
    "sea": "calm",
    "goal_distance_m": (0.7, 1.2),
    "goal_tolerance_m": 0.6,
    "reward": "dense",
    "step_limit": 24,
}
"""Water that an untrained network often crosses; without waves nothing is chaotic."""

SMALL = [
    "evaluation.episodes=3",
    "evaluation.num_worlds=2",
    "logger.video_episodes=0",
    "task.step_limit=8",
    "task.goal_tolerance_m=0.5",
    "network.actor_cells=[8,8]",
]
LEARNER = ["algorithm.num_worlds=4", "algorithm.frames_per_batch=40"]
SMALL_OF_ALGORITHM = {
    "ppo": [*LEARNER, "algorithm.minibatch_size=20", "algorithm.num_epochs=1"],
    "rainbow": [
        *LEARNER,
        "algorithm.minibatch_size=16",
        "algorithm.updates_per_batch=2",
        "algorithm.num_steps=3",
        "algorithm.num_atoms=11",
        "algorithm.warmup_steps=60",
        "algorithm.replay_capacity=200",
    ],
    "ga": [
        "algorithm.population_size=4",
        "algorithm.num_parents=2",
        "algorithm.num_validated=2",
        "algorithm.num_trials=2",
        "algorithm.validation_trials=2",
    ],
}
SMALL_ERL = [
    "evolution.population_size=4",
    "evolution.num_elites=1",
    "evolution.num_trials=2",
]
SMALL_GENETIC = [
    "evolution.num_children=3",
    "evolution.num_trials=2",
    "evolution.period_episodes=8",
    "evolution.screening_trials=1",
    "evolution.test_trials=2",
]


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
def small_options() -> Callable[[str], list[str]]:
    """Overrides that make an experiment small; it has 40 steps of the agent a row."""

    def options(experiment: str) -> list[str]:
        config = load_experiment([f"experiment={experiment}"])
        chosen = [f"experiment={experiment}", *SMALL]
        chosen += SMALL_OF_ALGORITHM[config.algorithm.name]
        if config.evolution.enabled:
            is_erl = isinstance(config.evolution, ErlConfig)
            chosen += SMALL_ERL if is_erl else SMALL_GENETIC
        return chosen

    return options


@pytest.fixture
def easy_task_for() -> Callable[..., object]:
    """Makes an easy task whose actions fit a kind of actor."""

    def make(kind: str = "tanh_normal", **options: object) -> object:
        actions = "discrete" if kind in DISCRETE else "continuous"
        return make_task("water", **EASY | {"actions": actions} | options)

    return make
