"""Policies unlike our own, each with an environment that it fits."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Bounded, Categorical
from torchrl.envs import (
    Compose,
    EnvBase,
    GymWrapper,
    InitTracker,
    TransformedEnv,
)
from torchrl.modules import (
    MLP,
    ActorValueOperator,
    DistributionalQValueActor,
    GRUModule,
    LSTMModule,
    MaskedCategorical,
    NormalParamExtractor,
    ProbabilisticActor,
    QValueActor,
    TanhNormal,
    ValueOperator,
)

from tests.contracts.environments import (
    Panel,
    Picture,
    TwoArms,
    cart_pole,
    masked,
    one_in_a_batch,
    pendulum,
)


@dataclasses.dataclass(frozen=True)
class Case:
    """A policy and where it acts."""

    name: str
    make: Callable[[], tuple[Any, EnvBase]]
    refusal: str | None = None
    """What the error says, where the policy is refused."""


def deterministic(network: nn.Module) -> TensorDictModule:
    """Pendulum's torque by a network of three numbers."""
    torque = nn.Sequential(network, nn.Linear(8, 1), nn.Tanh(), Doubled())
    return TensorDictModule(torque, ["observation"], ["action"])


class Doubled(nn.Module):
    def forward(self, value: torch.Tensor) -> torch.Tensor:
        return 2.0 * value


class Tied(nn.Module):
    """Two layers with the same weights."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(8, 8), nn.Linear(8, 8)
        self.second.weight = self.first.weight
        self.inner = nn.Linear(3, 8)

    def forward(self, value: torch.Tensor) -> torch.Tensor:
        hidden = torch.tanh(self.first(self.inner(value)))
        return torch.tanh(self.second(hidden))


class RunningNormaliser(nn.Module):
    """Follows the mean of what it is shown while it trains."""

    def __init__(self, *, in_place: bool) -> None:
        super().__init__()
        self.in_place = in_place
        self.register_buffer("mean", torch.zeros(3))

    def forward(self, value: torch.Tensor) -> torch.Tensor:
        if self.training:
            now = value.detach().reshape(-1, 3).mean(0)
            if self.in_place:
                self.mean.lerp_(now, 0.1)
            else:
                self.mean = self.mean + 0.1 * (now - self.mean)
        return value - self.mean


class InDouble(nn.Module):
    """Computes with double precision."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 8).double()

    def forward(self, value: torch.Tensor) -> torch.Tensor:
        return self.layer(value.double()).float()


class Forbidding(nn.Module):
    """Logits of which one is minus infinity, by what is observed."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(4, 2)

    def forward(self, value: torch.Tensor) -> torch.Tensor:
        forbidden = torch.stack([value[..., 2] > 0.03, value[..., 2] < -0.03], dim=-1)
        return self.layer(value).masked_fill(forbidden, -torch.inf)


def tanh_normal(inner: nn.Module | None = None, key: str = "observation") -> Any:
    network = nn.Sequential(inner or MLP(3, 2, num_cells=[8]), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(network, [key], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=Bounded(-2.0, 2.0, shape=(1,)),
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -2.0, "high": 2.0},
    )


def shared_trunk() -> Any:
    trunk = TensorDictModule(
        nn.Sequential(nn.Linear(3, 16), nn.Tanh()), ["observation"], ["hidden"]
    )
    head = tanh_normal(nn.Linear(16, 2), "hidden")
    value = ValueOperator(nn.Linear(16, 1), ["hidden"])
    return ActorValueOperator(trunk, head, value).get_policy_operator()


def recurrent(kind: type, **options: Any) -> tuple[Any, EnvBase]:
    memory = kind(
        input_size=3, hidden_size=8, in_key="observation", out_key="hidden", **options
    )
    policy = TensorDictSequential(memory, tanh_normal(nn.Linear(8, 2), "hidden"))
    primer = memory.make_tensordict_primer()
    return policy, TransformedEnv(pendulum(), Compose(InitTracker(), primer))


class Switches(nn.Module):
    """One choice of three and one of two, as MultiDiscrete asks for."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 5)

    def forward(self, dial: torch.Tensor, lamp: torch.Tensor) -> torch.Tensor:
        values = self.layer(torch.cat([dial, lamp], dim=-1))
        first, second = values.split([3, 2], dim=-1)
        return torch.stack([first.argmax(-1), second.argmax(-1)], dim=-1)


def two_actions() -> Any:
    return TensorDictSequential(
        TensorDictModule(MLP(2, 2, num_cells=[8]), ["observation"], ["both"]),
        TensorDictModule(
            lambda both: torch.tanh(both).chunk(2, dim=-1),
            ["both"],
            ["left", ("arm", "right")],
        ),
    )


def _with_layers(
    *layers: Callable[[], nn.Module],
    mode: str = "train",
    env: Callable[[], EnvBase] = pendulum,
) -> Callable:
    def make() -> tuple[Any, EnvBase]:
        network = nn.Sequential(*(layer() for layer in layers))
        return deterministic(network).train(mode == "train"), env()

    return make


def _old_weight_norm() -> nn.Module:
    with warnings.catch_warnings(action="ignore", category=FutureWarning):
        return torch.nn.utils.weight_norm(nn.Linear(3, 8))


def _distributional() -> Any:
    network = nn.Sequential(MLP(4, 22, num_cells=[8]), nn.Unflatten(-1, (11, 2)))
    return DistributionalQValueActor(
        network, torch.linspace(-1.0, 1.0, 11), ["observation"], Categorical(2)
    )


def _categorical(network: nn.Module, **options: Any) -> Any:
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["logits"]),
        spec=Categorical(2),
        **(
            {"in_keys": ["logits"], "distribution_class": torch.distributions.Categorical}
            | options
        ),
    )


def _q_value(**options: Any) -> Any:
    network = MLP(4, 2, num_cells=[8])
    return QValueActor(network, in_keys=["observation"], spec=Categorical(2), **options)


def _cnn() -> Any:
    return TensorDictModule(
        nn.Sequential(
            nn.Conv2d(1, 4, 3), nn.ReLU(), nn.Flatten(-3), nn.Linear(144, 1), nn.Tanh()
        ),
        ["observation"],
        ["action"],
    )


_LINEAR = lambda: nn.Linear(3, 8)  # noqa: E731

CASES = (
    Case("tanh-normal", lambda: (tanh_normal(), pendulum())),
    Case("deterministic", _with_layers(_LINEAR)),
    Case("Q-value", lambda: (_q_value(), cart_pole())),
    Case(
        "Q-value with `action_mask_key`",
        lambda: (_q_value(action_mask_key="action_mask"), masked()),
    ),
    Case("distributional Q-value", lambda: (_distributional(), cart_pole())),
    Case("categorical", lambda: (_categorical(MLP(4, 2, num_cells=[8])), cart_pole())),
    Case(
        "`MaskedCategorical`",
        lambda: (
            _categorical(
                MLP(4, 2, num_cells=[8]),
                in_keys={"logits": "logits", "mask": "action_mask"},
                distribution_class=MaskedCategorical,
            ),
            masked(),
        ),
    ),
    Case(
        "categorical with logits of minus infinity",
        lambda: (_categorical(Forbidding()), cart_pole()),
    ),
    Case("LSTM", lambda: recurrent(LSTMModule)),
    Case("LSTM, `python_based`", lambda: recurrent(LSTMModule, python_based=True)),
    Case("GRU", lambda: recurrent(GRUModule)),
    Case("GRU, `python_based`", lambda: recurrent(GRUModule, python_based=True)),
    Case(
        "LSTM without a primer in the environment",
        lambda: (recurrent(LSTMModule)[0], pendulum()),
        "the policy reads",
    ),
    Case("CNN", lambda: (_cnn(), GymWrapper(Picture()))),
    Case("trunk shared with the critic", lambda: (shared_trunk(), pendulum())),
    Case("tied weights", _with_layers(Tied)),
    Case("dropout, `eval()`", _with_layers(_LINEAR, nn.Dropout, mode="eval")),
    Case("dropout, `train()`", _with_layers(_LINEAR, nn.Dropout)),
    Case(
        "batch norm, `eval()`",
        _with_layers(_LINEAR, lambda: nn.BatchNorm1d(8), mode="eval", env=one_in_a_batch),
    ),
    Case(
        "batch norm, `train()`, one world",
        _with_layers(_LINEAR, lambda: nn.BatchNorm1d(8), env=one_in_a_batch),
        "Expected more than 1 value per channel",
    ),
    Case(
        "running normaliser, `eval()`",
        _with_layers(lambda: RunningNormaliser(in_place=True), _LINEAR, mode="eval"),
    ),
    Case(
        "running normaliser, `train()`",
        _with_layers(lambda: RunningNormaliser(in_place=True), _LINEAR),
    ),
    Case(
        "the same, its buffer replaced",
        _with_layers(lambda: RunningNormaliser(in_place=False), _LINEAR),
    ),
    Case(
        "weight norm (`parametrizations`)",
        _with_layers(lambda: torch.nn.utils.parametrizations.weight_norm(nn.Linear(3, 8))),
    ),
    Case("weight norm (`torch.nn.utils.weight_norm`)", _with_layers(_old_weight_norm)),
    Case(
        "spectral norm, `eval()`",
        _with_layers(
            lambda: torch.nn.utils.parametrizations.spectral_norm(nn.Linear(3, 8)),
            mode="eval",
        ),
    ),
    Case(
        "spectral norm, `train()`",
        _with_layers(
            lambda: torch.nn.utils.parametrizations.spectral_norm(nn.Linear(3, 8))
        ),
    ),
    Case("double precision", _with_layers(InDouble)),
    Case("two actions, one nested", lambda: (two_actions(), TwoArms())),
    Case(
        "Gymnasium's `Dict` and `MultiDiscrete`",
        lambda: (
            TensorDictModule(Switches(), ["dial", "lamp"], ["action"]),
            GymWrapper(Panel(), categorical_action_encoding=True),
        ),
    ),
)
