"""A mutation with heavy tails."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase


def cauchy_mutation(
    genomes: TensorDictBase, *, mut_p: float, std: float, generator: torch.Generator
) -> TensorDictBase:
    """Add Cauchy noise of scale ``std`` to each weight with probability ``mut_p``.

    Args:
        genomes: ``[P]``; leaves ``[P, *shape]``.
        mut_p: Probability that a weight mutates.
        std: Scale of the noise (a Cauchy distribution has no standard deviation).
        generator: Source of randomness.

    Returns:
        New genomes ``[P]``.
    """

    def mutate(leaf: torch.Tensor) -> torch.Tensor:
        where, noise = torch.rand(2, *leaf.shape, generator=generator)
        chosen = where < mut_p
        return leaf + std * torch.tan(math.pi * (noise - 0.5)) * chosen

    return genomes.apply(mutate)
