"""The genome of a policy: which parameters evolve, stacking them, installing them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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


def paths_of_part(genome: TensorDictBase, part: str) -> list[tuple[str, ...]]:
    """Names of the leaves of a part of a policy.

    Args:
        genome: Of the policy, as :func:`genome_of` gives it.
        part: ``all``; ``advantage``, a dueling network's stream of that name; or ``head``,
            the last layer of that stream or, without one, of the policy.

    Raises:
        ValueError: If there is no such part.

    Examples:
        >>> network = nn.Sequential(nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 2))
        >>> paths_of_part(genome_of(network), "head")
        [('2', 'weight'), ('2', 'bias')]
    """
    found = genome.keys(include_nested=True, leaves_only=True)
    paths = [(name,) if isinstance(name, str) else tuple(name) for name in found]
    if part == "all":
        return paths
    stream = [path for path in paths if "advantage" in path]
    if part == "head":
        last = (stream or paths)[-1][:-1]
        return [path for path in paths if path[:-1] == last]
    if part != "advantage":
        raise ValueError(f"part={part!r} must be 'all', 'head' or 'advantage'")
    if not stream:
        raise ValueError("genome='advantage': the policy has no stream of that name")
    return stream


def only_part(
    parents: TensorDictBase, children: TensorDictBase, paths: Iterable[tuple[str, ...]]
) -> TensorDictBase:
    """Parents ``[P]`` with some leaves of their children ``[P]``, as a new tensordict."""
    mixed = parents.clone()
    for path in paths:
        mixed.set(path, children.get(path).clone())
    return mixed


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


def fitting_leaves(
    genomes: TensorDictBase, parameters: Mapping[str, torch.Tensor], owner: str
) -> dict[str, torch.Tensor]:
    """Leaves of genomes by name, checked against a module's parameters.

    Args:
        genomes: Values by nested name, batch size ``[]`` or ``[P]``.
        parameters: The module's parameters, by dotted name.
        owner: What the module is called in errors.

    Raises:
        ValueError: If a name is not the module's, or a leaf's type, or its shape without
            the batch, is not its parameter's. The error names the leaf.

    Examples:
        >>> layer = nn.Linear(3, 2)
        >>> parameters = dict(layer.named_parameters())
        >>> list(fitting_leaves(genome_of(layer), parameters, "the layer"))
        ['weight', 'bias']
    """
    size = genomes.batch_size
    leaves: dict[str, torch.Tensor] = {}
    for path, value in genomes.items(include_nested=True, leaves_only=True):
        name = path if isinstance(path, str) else ".".join(path)
        leaves[name] = value
    for name, value in leaves.items():
        if name not in parameters:
            raise ValueError(f"{owner} has no parameter {name!r}, which the genome has")
        own, shape = parameters[name], value.shape[len(size) :]
        if shape != own.shape:
            raise ValueError(
                f"{name} has shape {tuple(own.shape)}, the genome's is {tuple(shape)}"
            )
        if value.dtype != own.dtype:
            raise ValueError(f"{name} is {own.dtype}, the genome's is {value.dtype}")
    return leaves


@torch.no_grad()
def install(module: nn.Module, genome: TensorDictBase) -> None:
    """Write a genome into a module in place: the same Parameter objects, new values.

    Args:
        module: The module that :func:`genome_of` was called on, or one like it.
        genome: Values by nested name, batch size ``[]``.

    Raises:
        ValueError: If a name, a shape or a type is not the module's; nothing is changed.

    Examples:
        >>> layer = nn.Linear(3, 2)
        >>> weight = layer.weight
        >>> install(layer, genome_of(layer).zero_())
        >>> weight is layer.weight, float(weight.abs().sum())
        (True, 0.0)
    """
    parameters = dict(module.named_parameters())
    leaves = fitting_leaves(genome, parameters, type(module).__name__)
    for name, value in leaves.items():
        parameters[name].copy_(value)
