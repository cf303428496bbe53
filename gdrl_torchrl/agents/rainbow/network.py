"""Distributional Q-value actors for discrete actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torch.nn.functional import linear
from torchrl.data import Categorical, TensorSpec
from torchrl.modules import (
    MLP,
    DistributionalQValueActor,
    DistributionalQValueModule,
    NoisyLinear,
)

from gdrl_torchrl import keys
from gdrl_torchrl.agents.batched import batched_linear, batched_mlp, weights_of
from gdrl_torchrl.agents.networks import Greedy


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
) -> DuelingActor:
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
            the others are shared. A single width is a shared layer, and the streams are
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
    # Input sizes are given, so that no layer is lazy: weights of lazy layers do not exist
    # before a first call, so they could not evolve or be copied to a target network.
    streams: dict[str, Any] = {
        "in_features": shared[-1],
        "num_cells": hidden,
        "depth": len(hidden),
        "activation_class": activation,
    }
    if noisy:
        streams["layer_class"] = NoisyLinear
        streams["layer_kwargs"] = {"std_init": noisy_std}
    features = MLP(
        in_features=observation_size,
        out_features=shared[-1],
        num_cells=list(shared[:-1]),
        activation_class=activation,
        activate_last_layer=True,
    )
    actor = DuelingActor(
        _DuelingNetwork(
            features,
            advantage=MLP(out_features=num_actions * num_atoms, **streams),
            value=MLP(out_features=num_atoms, **streams),
        ),
        support=torch.linspace(low, high, num_atoms),
        in_keys=[keys.OBSERVATION],
        spec=spec,
        make_log_softmax=False,
    )
    head: Any = actor.module[-1]
    head.__class__ = _Head
    return actor


class DuelingActor(DistributionalQValueActor):
    """The policy of the best expected value, many members of which act as one batch."""

    @property
    def is_deterministic(self) -> bool:
        """Whether it acts alike in every exploration mode: it has no noisy layer."""
        return not any(isinstance(module, NoisyLinear) for module in self.modules())

    def prepared(self, params: TensorDictBase) -> Greedy | None:
        """Make the greedy policy of members with parameters ``[P]``, nested by name.

        Returns:
            None if actions are not numbers from 0.
        """
        if self.action_space != "categorical":
            return None
        parts: Any = self.module
        logits_of = parts[0].module.prepared(params["module", "0", "module"])
        support = params["support"][0]

        def act(observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            logits = logits_of(observation)
            return (logits.softmax(-1) @ support).argmax(-1), logits

        return act


class _DuelingNetwork(nn.Module):
    """Logits ``[..., Z, A]`` of two streams, computed as one.

    Equal layers of the two streams are computed as one product. The mean over actions is
    taken of the last layer's weights and not of its values: for a population this is done
    once, when its weights are given. TorchRL's ``DuelingMlpDQNet`` keeps actions side by
    side in memory; here atoms are side by side, so that a softmax over them, here and in
    the loss, takes half the time.
    """

    def __init__(self, features: MLP, *, advantage: MLP, value: MLP) -> None:
        super().__init__()
        self.features, self.advantage, self.value = features, advantage, value
        for layer in self.modules():
            # Initial values as in TorchRL's network, except for the noise of noisy layers.
            if type(layer) is nn.Linear:
                nn.init.zeros_(layer.bias)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        features = self.features(observation)
        apart, together = features, features
        if len(self.value) > 1:
            first: list[Any] = [self.advantage[0], self.value[0]]
            weight = torch.cat([layer.weight for layer in first])
            bias = torch.cat([layer.bias for layer in first])
            hidden = self.value[1](linear(features, weight, bias))
            apart, together = hidden.chunk(2, dim=-1)
        advantage: Any = self.advantage[-1]
        value: Any = self.value[-1]
        weight, bias = _folded(advantage.weight, advantage.bias, value.bias)
        logits = linear(apart, weight, bias).unflatten(-1, (-1, len(value.bias)))
        shared = linear(together, value.weight).unsqueeze(-2)
        return (logits + shared).transpose(-1, -2)

    def prepared(self, params: TensorDictBase) -> Callable[[torch.Tensor], torch.Tensor]:
        """Make ``observations [P, K, D] -> logits [P, K, A, Z]`` of members ``[P]``."""
        features = batched_mlp(self.features, params["features"])
        streams: list[Any] = [params["advantage"], params["value"]]
        hidden: Any = None
        if len(self.value) > 1:
            first = zip(*(weights_of(stream["0"]) for stream in streams), strict=True)
            hidden = batched_linear(*(torch.cat(both, dim=1) for both in first))
        last = [weights_of(stream[str(len(self.value) - 1)]) for stream in streams]
        (weight, bias), (shared_weight, shared_bias) = last
        advantages = batched_linear(*_folded(weight, bias, shared_bias))
        values = batched_linear(shared_weight)
        shape = -1, shared_bias.shape[-1]

        def run(observation: torch.Tensor) -> torch.Tensor:
            apart = together = features(observation)
            if hidden is not None:
                apart, together = self.value[1](hidden(apart)).chunk(2, dim=-1)
            return (
                advantages(apart).unflatten(-1, shape).add_(values(together).unsqueeze(-2))
            )

        return run


def _folded(
    weight: torch.Tensor, bias: torch.Tensor, shared: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The last layer of the advantages, less its mean over actions.

    Args:
        weight: Weights ``[..., A * Z, H]``.
        bias: Biases ``[..., A * Z]``.
        shared: Biases of the value's last layer ``[..., Z]``, which are added.
    """
    atoms = shared.shape[-1]
    weight = weight.unflatten(-2, (-1, atoms))
    weight = weight - weight.mean(dim=-3, keepdim=True)
    bias = bias.unflatten(-1, (-1, atoms))
    bias = bias - bias.mean(dim=-2, keepdim=True) + shared.unsqueeze(-2)
    return weight.flatten(-3, -2), bias.flatten(-2)


class _Head(DistributionalQValueModule):
    """TorchRL's choice of the action with the best mean, from logits ``[..., Z, A]``.

    It also normalises, so that this is left out where only the action is asked for. It
    leaves out TorchRL's check of the sign, which reads numbers and would keep the actor
    from being traced.
    """

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = super().forward(tensordict)
        logits = tensordict.get(self.action_value_key).transpose(-1, -2)
        logarithms = logits.log_softmax(-1).transpose(-1, -2)
        return tensordict.set(self.action_value_key, logarithms)

    def _support_expected(
        self, log_softmax_values: torch.Tensor, support: torch.Tensor | None = None
    ) -> torch.Tensor:
        chosen: Any = self.support if support is None else support
        return log_softmax_values.transpose(-1, -2).softmax(-1) @ chosen
