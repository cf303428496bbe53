"""Actors and critics without a distribution over returns."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical
from torchrl.modules import (
    MLP,
    ProbabilisticActor,
    QValueActor,
    TanhNormal,
    ValueOperator,
)

from gdrl_torchrl import keys
from gdrl_torchrl.agents.batched import batched_mlp

Greedy = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]
"""Observations ``[P, K, D]`` of members to their greedy actions ``[P, K, ...]`` and the
outputs of their networks that these are chosen by ``[P, K, ...]``."""

_LARGEST_TANH = 1.0 - torch.finfo(torch.float32).resolution
"""As TorchRL's ``TanhNormal`` has it, so that actions have a finite inverse."""


class TanhNormalActor(ProbabilisticActor):
    """A squashed Gaussian policy of an ``MLP``, many members of which act as one batch."""

    def prepared(self, params: TensorDictBase) -> Greedy | None:
        """Make the greedy policy of members with parameters ``[P]``, nested by name.

        Returns:
            None if a scale is not a number, which none of what it would give could tell.
        """
        parts: Any = self.module
        (layers, _), head = parts[0].module, parts[1]
        own: Any = params["module", "0", "module"]
        locations = batched_mlp(layers, own["0"])
        scale = own["1", "state_independent_scale"].exp()
        if not scale.isfinite().all():
            return None
        bounds = head.distribution_kwargs
        low, high = (torch.as_tensor(bounds[name]) for name in ("low", "high"))
        center, reach = (high + low) / 2, (high - low) / 2
        is_scaled = bool((center != 0).any() or (reach != 1).any())

        def act(observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            loc = locations(observation)
            # Not in place: children are also fitted to actions, by their gradients.
            action = torch.tanh(loc).clamp(-_LARGEST_TANH, _LARGEST_TANH)
            return center + reach * action if is_scaled else action, loc

        return act


class ArgmaxActor(QValueActor):
    """A policy of the largest output, many members of which act as one batch."""

    def prepared(self, params: TensorDictBase) -> Greedy:
        """Make the policy of members with parameters ``[P]``, nested by name."""
        parts: Any = self.module
        head = parts[1]
        values_of = batched_mlp(parts[0].module, params["module", "0", "module"])
        choose = head.action_func_mapping[head.action_space]

        def act(observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            values = values_of(observation)
            return choose(values), values

        return act


def make_tanh_normal_actor(
    observation_size: int,
    action_spec: Bounded,
    *,
    num_cells: tuple[int, ...] = (32, 32),
    activation: type[nn.Module] = nn.Tanh,
    initial_std: float = 1.0,
) -> TanhNormalActor:
    """Make a squashed Gaussian policy with a state-independent standard deviation.

    Args:
        observation_size: Length ``D`` of the observation.
        action_spec: Spec of one world's action, ``[A]`` (no batch dimension).
        num_cells: Widths of the hidden layers.
        activation: Activation of the hidden layers.
        initial_std: Initial standard deviation before squashing.

    Returns:
        An actor that reads ``observation`` and writes ``loc``, ``scale``, ``action``
        and ``action_log_prob``; deterministic under ``ExplorationType.DETERMINISTIC``.

    Examples:
        >>> from tensordict import TensorDict
        >>> spec = Bounded(-1, 1, shape=(2,))
        >>> actor = make_tanh_normal_actor(3, spec)
        >>> actor(TensorDict(observation=torch.zeros(5, 3), batch_size=[5]))["action"].shape
        torch.Size([5, 2])
    """
    size = action_spec.shape[-1]
    scale = AddStateIndependentNormalScale(size, scale_mapping="exp")
    network = nn.Sequential(
        MLP(
            in_features=observation_size,
            out_features=size,
            num_cells=list(num_cells),
            activation_class=activation,
        ),
        scale,
    )
    with torch.no_grad():
        scale.state_independent_scale.fill_(math.log(initial_std))
    return TanhNormalActor(
        TensorDictModule(network, in_keys=[keys.OBSERVATION], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=action_spec,
        distribution_class=TanhNormal,
        distribution_kwargs={
            "low": _number(action_spec.low),
            "high": _number(action_spec.high),
            "tanh_loc": False,
        },
        return_log_prob=True,
    )


def _number(bound: torch.Tensor) -> torch.Tensor | float:
    """A bound as a number, if it is the same for all commands.

    Whenever TorchRL's distribution is made, it reads the values of bounds that are
    tensors. That takes time and keeps a policy from being traced.
    """
    values = bound.unique()
    return values.item() if len(values) == 1 else bound


def make_value_network(
    observation_size: int,
    *,
    num_cells: tuple[int, ...] = (64, 64),
    activation: type[nn.Module] = nn.Tanh,
    sees_time: bool = False,
) -> ValueOperator:
    """Make a state-value network that reads ``observation`` and writes ``state_value``.

    Args:
        observation_size: Length ``D`` of the observation.
        num_cells: Widths of the hidden layers.
        activation: Activation of the hidden layers.
        sees_time: Whether it reads ``time_left`` too. If the step limit carries a
            reward, the time left is part of the state. A critic that cannot see it
            cannot expect a timeout; while most episodes fail, this is the larger part
            of the noise in the advantages.

    Examples:
        >>> from tensordict import TensorDict
        >>> critic = make_value_network(3)
        >>> critic(TensorDict(observation=torch.zeros(5, 3), batch_size=[5]))[
        ...     "state_value"
        ... ].shape
        torch.Size([5, 1])
    """
    network = MLP(
        in_features=observation_size + int(sees_time),
        out_features=1,
        num_cells=list(num_cells),
        activation_class=activation,
    )
    in_keys = [keys.OBSERVATION, keys.TIME_LEFT] if sees_time else [keys.OBSERVATION]
    return ValueOperator(network, in_keys=in_keys)


def make_argmax_actor(
    observation_size: int,
    action_spec: Categorical,
    *,
    num_cells: tuple[int, ...] = (64, 64),
    activation: type[nn.Module] = nn.ReLU,
) -> ArgmaxActor:
    """Make a policy that takes the action with the largest output.

    Args:
        observation_size: Length ``D`` of the observation.
        action_spec: Spec of one world's action.
        num_cells: Widths of the hidden layers.
        activation: Activation of the hidden layers.

    Returns:
        An actor that reads ``observation`` ``[B, D]`` and writes ``action`` and
        ``action_value`` ``[B, A]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> actor = make_argmax_actor(3, Categorical(5))
        >>> actor(TensorDict(observation=torch.zeros(7, 3), batch_size=[7]))["action"].shape
        torch.Size([7])
    """
    network = MLP(
        in_features=observation_size,
        out_features=action_spec.n,
        num_cells=list(num_cells),
        activation_class=activation,
    )
    return ArgmaxActor(network, in_keys=[keys.OBSERVATION], spec=action_spec)
