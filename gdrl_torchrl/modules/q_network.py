"""Distributional Q-value actors for discrete actions."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torchrl.data import Categorical, TensorSpec
from torchrl.modules import (
    DistributionalQValueActor,
    DistributionalQValueModule,
    NoisyLinear,
)
from torchrl.modules.models.models import DuelingMlpDQNet

from gdrl_torchrl import keys


def make_q_actor(
    observation_size: int,
    num_actions: int,
    *,
    value_range: tuple[float, float],
    num_atoms: int = 51,
    num_cells: tuple[int, ...] = (64, 64),
    activation: type[nn.Module] = nn.ReLU,
    noisy: bool = False,
    noisy_std: float = 0.5,
    spec: TensorSpec | None = None,
) -> DistributionalQValueActor:
    """Make Rainbow's network: distributional, dueling and, if asked for, noisy.

    Categorical values (arXiv 1707.06887), one stream for the state's value and one for
    the advantages (arXiv 1511.06581) per atom as in Rainbow (arXiv 1710.02298), and
    factorised noise on the weights of both streams (arXiv 1706.10295).

    The greedy policy (``ExplorationType.DETERMINISTIC``, and outside every
    exploration context) uses no noise; ``ExplorationType.RANDOM`` uses the noise drawn
    last. No call draws new noise: ``actor.apply(torchrl.modules.reset_noise)`` does.

    Args:
        observation_size: Length ``D`` of the observation.
        num_actions: Number of actions ``A``.
        value_range: Lowest and highest discounted return that the network can express.
        num_atoms: Number of returns ``Z``, evenly spaced over the range.
        num_cells: Widths of the hidden layers: the last one is a layer in each stream,
            those before it are shared. A single width is shared; the streams are
            linear then.
        activation: Activation of the hidden layers.
        noisy: Whether the streams are noisy.
        noisy_std: Initial scale of the noise.
        spec: Spec of one world's action, ``Categorical(num_actions)`` by default.

    Returns:
        An actor that reads ``observation`` ``[B, D]`` and writes ``action`` and
        ``action_value`` ``[B, Z, A]``, the logarithms of probabilities.

    Raises:
        ValueError: If a size is too small, the range is empty or the spec is for
            another number of actions.

    Examples:
        >>> from tensordict import TensorDict
        >>> actor = make_q_actor(3, 5, value_range=(-1.0, 1.0))
        >>> out = actor(TensorDict(observation=torch.zeros(7, 3), batch_size=[7]))
        >>> out["action"].shape, out["action_value"].shape
        (torch.Size([7]), torch.Size([7, 51, 5]))
    """
    low, high = value_range
    if not low < high:
        raise ValueError(f"value_range must be (low, high) with low < high: {value_range}")
    if num_atoms < 2:
        raise ValueError(f"num_atoms must be at least 2: {num_atoms}")
    if not num_cells or min(num_cells) < 1:
        raise ValueError(f"num_cells must be one or more positive widths: {num_cells}")
    spec = Categorical(num_actions) if spec is None else spec
    actions_of_spec = getattr(spec.space, "n", None)
    if actions_of_spec != num_actions:
        raise ValueError(f"num_actions is {num_actions}, the spec has {actions_of_spec}")

    shared = num_cells[:-1] or num_cells
    hidden = list(num_cells[len(shared) :])
    # Sizes are given everywhere: the weights of lazy layers do not exist before a
    # first call, so they could neither evolve nor be copied to a target network.
    streams: dict[str, Any] = {
        "in_features": shared[-1],
        "num_cells": hidden,
        "depth": len(hidden),
        "activation_class": activation,
    }
    if noisy:
        streams["layer_class"] = NoisyLinear
        streams["layer_kwargs"] = {"std_init": noisy_std}
    per_state: Any = (num_atoms, 1)
    network = DuelingMlpDQNet(
        out_features=torch.Size((num_atoms, num_actions)),
        out_features_value=per_state,
        mlp_kwargs_feature={
            "in_features": observation_size,
            "num_cells": list(shared[:-1]),
            "out_features": shared[-1],
            "activation_class": activation,
        },
        mlp_kwargs_output=streams,
    )
    actor = DistributionalQValueActor(
        network,
        support=torch.linspace(low, high, num_atoms),
        in_keys=[keys.OBSERVATION],
        spec=spec,
    )
    head: Any = actor.module[-1]
    head.__class__ = _TraceableHead
    return actor


class _TraceableHead(DistributionalQValueModule):
    """TorchRL's choice of the action with the best mean, without a look at the data.

    Its check that the logarithms are not positive would keep the actor from being
    traced; here a layer before has normalised them.
    """

    def _support_expected(
        self, log_softmax_values: torch.Tensor, support: torch.Tensor | None = None
    ) -> torch.Tensor:
        chosen: Any = self.support if support is None else support
        return (log_softmax_values.exp() * chosen.unsqueeze(-1)).sum(-2)
