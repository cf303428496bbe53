"""Networks of many members at once: their weights folded once, their rows multiplied."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from tensordict import TensorDictBase
from torch import nn

Layer = Callable[[torch.Tensor], torch.Tensor]
_IN_PLACE: dict[type[nn.Module], Layer] = {nn.Tanh: torch.tanh_, nn.ReLU: torch.relu_}
_FEW_COLUMNS = 4
"""With fewer columns a product is not faster with columns side by side in memory, and its
last digits are others."""


def batched_linear(weight: torch.Tensor, bias: torch.Tensor | None = None) -> Layer:
    """Make ``x [P, K, I] -> [P, K, O]``, each member with weights of its own.

    Args:
        weight: Weights of ``P`` linear layers, ``[P, O, I]``.
        bias: Their biases ``[P, O]``, if they have some.

    Examples:
        >>> layer = batched_linear(torch.ones(4, 5, 3), torch.zeros(4, 5))
        >>> layer(torch.ones(4, 2, 3))[0]
        tensor([[3., 3., 3., 3., 3.],
                [3., 3., 3., 3., 3.]])
    """
    columns = weight.mT
    if columns.shape[-1] >= _FEW_COLUMNS:
        # For a few rows this takes half the time of a product with the transposed view.
        columns = columns.contiguous()
    if bias is None:
        return lambda x: torch.bmm(x, columns)
    rows = bias.unsqueeze(-2)
    return lambda x: torch.baddbmm(rows, x, columns)


def batched_mlp(layers: Iterable[nn.Module], params: TensorDictBase) -> Layer:
    """Make ``x [P, K, I] -> [P, K, O]``: layers in a row, each member with own weights.

    Args:
        layers: What ``nn.Sequential`` or TorchRL's ``MLP`` holds: linear layers, noisy
            ones, and activations, which act on each number or on the last dimension. The
            noise of noisy layers is left out, as the greedy policy does.
        params: Their parameters ``[P]``, by number of the layer.

    Examples:
        >>> from tensordict import TensorDict
        >>> network = nn.Sequential(nn.Linear(3, 5), nn.Tanh())
        >>> weights = TensorDict.from_module(network).detach().expand(4)
        >>> batched_mlp(network, weights)(torch.zeros(4, 2, 3)).shape
        torch.Size([4, 2, 5])
    """
    steps: list[Layer] = []
    is_product = False
    for number, layer in enumerate(layers):
        own = params.get(str(number), None)
        # A product belongs to nobody else, so an activation may overwrite it.
        step = _IN_PLACE.get(type(layer), layer) if is_product else layer
        is_product = own is not None and not own.is_empty()
        if own is not None and is_product:
            step = batched_linear(*weights_of(own))
        steps.append(step)

    def run(x: torch.Tensor) -> torch.Tensor:
        for step in steps:
            x = step(x)
        return x

    return run


def weights_of(params: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights ``[P, O, I]`` and biases ``[P, O]`` of a layer, means if it is noisy."""
    mean = "_mu" if "weight_mu" in params else ""
    return params[f"weight{mean}"], params[f"bias{mean}"]
