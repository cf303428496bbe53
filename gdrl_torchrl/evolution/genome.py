"""The genome of a policy: which parameters evolve, stacking them, installing them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn

UNSEEN_PARAMETERS = ("state_independent_scale", "weight_sigma", "bias_sigma")
"""Parameters that a greedy fitness cannot see: exploration noise of policies."""


def genome_of(
    module: nn.Module, *, exclude: Iterable[str] = UNSEEN_PARAMETERS
) -> TensorDictBase:
    """Copy the evolving parameters of a module; buffers never evolve.

    Args:
        module: A policy network or actor.
        exclude: Last names of parameters that do not evolve.

    Returns:
        Detached copies by nested name, batch size ``[]``.

    Raises:
        ValueError: If nothing evolves, or a parameter is not initialised yet (lazy
            layers).

    Examples:
        >>> genome_of(nn.Linear(3, 2))["weight"].shape
        torch.Size([2, 3])
    """
    exclude = set(exclude)
    genome = TensorDict()
    for name, parameter in module.named_parameters():
        path = tuple(name.split("."))
        if path[-1] in exclude:
            continue
        if isinstance(parameter, nn.parameter.UninitializedParameter):
            raise ValueError(f"parameter {name!r} is lazy: run the module once first")
        genome.set(path, parameter.detach().clone())
    if genome.is_empty():
        raise ValueError(f"{type(module).__name__} has no parameters that evolve")
    return genome


def stack_copies(genome: TensorDictBase, count: int) -> TensorDictBase:
    """``count`` copies of a genome as one tensordict ``[count]`` with its own memory.

    Examples:
        >>> stack_copies(genome_of(nn.Linear(3, 2)), 4)["weight"].shape
        torch.Size([4, 2, 3])
    """
    return genome.expand(count, *genome.batch_size).clone()


def concatenate(populations: Iterable[TensorDictBase]) -> TensorDictBase:
    """Join populations ``[P1], [P2], ...`` to one ``[P1 + P2 + ...]``."""
    joined: Any = TensorDict.cat(list(populations), dim=0)
    return joined


@torch.no_grad()
def install(module: nn.Module, genome: TensorDictBase) -> None:
    """Write a genome into a module in place: the same Parameter objects, new values.

    Args:
        module: The module that :func:`genome_of` was called on, or one like it.
        genome: Values by nested name, batch size ``[]``.

    Raises:
        ValueError: If a name or a shape is not the module's.

    Examples:
        >>> layer = nn.Linear(3, 2)
        >>> weight = layer.weight
        >>> install(layer, genome_of(layer).zero_())
        >>> weight is layer.weight, float(weight.abs().sum())
        (True, 0.0)
    """
    parameters = dict(module.named_parameters())
    values: dict[str, torch.Tensor] = {}
    for path, value in genome.items(include_nested=True, leaves_only=True):
        name = path if isinstance(path, str) else ".".join(path)
        if name not in parameters:
            raise ValueError(f"{type(module).__name__} has no parameter {name!r}")
        if parameters[name].shape != value.shape:
            raise ValueError(
                f"{name} has shape {tuple(parameters[name].shape)}, "
                f"the genome's is {tuple(value.shape)}"
            )
        values[name] = value
    # Only now: a genome that does not fit changes nothing.
    for name, value in values.items():
        parameters[name].copy_(value)
