"""Gaussian mutation of weights, in the three readings that the papers allow.

Marchesini and Farinelli (AAMAS 2020) write ``theta + mut_p * n`` with ``n ~ N(0, mut_v)``
and call mut_p the probability that a weight mutates; the successor of their paper
(Marchesini, Corsi and Farinelli, ICLR 2021, App. B) draws positions instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import TensorDictBase

from gdrl_torchrl.plugins import with_plugins


def bernoulli_mutation(
    genomes: TensorDictBase, *, mut_p: float, std: float, generator: torch.Generator
) -> TensorDictBase:
    """Add N(0, std^2) to each weight with probability ``mut_p``.

    Args:
        genomes: ``[P]`` genomes; leaves ``[P, *shape]``.
        mut_p: Probability that a weight mutates, in [0, 1].
        std: Standard deviation of the noise, in weight units.
        generator: Source of randomness.

    Returns:
        New genomes ``[P]``; the argument is not modified.

    Examples:
        >>> from tensordict import TensorDict
        >>> genomes = TensorDict(weight=torch.zeros(2, 3), batch_size=[2])
        >>> rng = torch.Generator().manual_seed(0)
        >>> bernoulli_mutation(genomes, mut_p=0.0, std=0.1, generator=rng)["weight"].sum()
        tensor(0.)
    """

    def mutate(leaf: torch.Tensor) -> torch.Tensor:
        noise = _normal(leaf, generator) * std
        chosen = torch.rand(leaf.shape, generator=generator, device=leaf.device) < mut_p
        return leaf + noise * chosen

    return genomes.apply(mutate)


def pseudocode_mutation(
    genomes: TensorDictBase, *, mut_p: float, std: float, generator: torch.Generator
) -> TensorDictBase:
    """Draw ``mut_p * size`` positions with replacement; add N(0, std^2) at each draw.

    The reading of ICLR 2021, App. B, matrix by matrix: a position that is drawn k
    times gets the sum of k draws, and a share 1 - exp(-mut_p) of the weights is
    touched. Arguments and result as in :func:`bernoulli_mutation`.
    """

    def mutate(leaf: torch.Tensor) -> torch.Tensor:
        flat = leaf.reshape(leaf.shape[0], -1)
        draws = round(mut_p * flat.shape[1])
        where = torch.randint(
            flat.shape[1],
            (flat.shape[0], draws),
            generator=generator,
            device=leaf.device,
        )
        noise = torch.randn(
            (flat.shape[0], draws),
            generator=generator,
            device=leaf.device,
            dtype=leaf.dtype,
        )
        return flat.scatter_add(1, where, noise * std).reshape(leaf.shape)

    return genomes.apply(mutate)


def scaled_mutation(
    genomes: TensorDictBase, *, mut_p: float, std: float, generator: torch.Generator
) -> TensorDictBase:
    """Add ``mut_p`` times N(0, std^2) to every weight: the formula in AAMAS 2020.

    Arguments and result as in :func:`bernoulli_mutation`.
    """
    return genomes.apply(lambda leaf: leaf + _normal(leaf, generator) * (mut_p * std))


MUTATIONS: dict[str, Callable[..., TensorDictBase]] = {
    "bernoulli": bernoulli_mutation,
    "pseudocode": pseudocode_mutation,
    "scaled": scaled_mutation,
}


def mutations() -> dict[str, Callable[..., TensorDictBase]]:
    """All mutations by name: ours, and those of other packages (``gdrl.mutations``).

    Examples:
        >>> sorted(mutations())[:2]
        ['bernoulli', 'pseudocode']
    """
    return with_plugins(MUTATIONS, "gdrl.mutations", needs=("__call__",))


def standard_deviation(mut_v: float, meaning: str) -> float:
    """Standard deviation that the papers' ``mut_v`` stands for.

    Raises:
        ValueError: If ``mut_v`` is negative or ``meaning`` unknown.

    Examples:
        >>> standard_deviation(0.1, "std")
        0.1
        >>> round(standard_deviation(0.1, "variance"), 3)
        0.316
    """
    if not mut_v >= 0.0:
        raise ValueError(f"mut_v={mut_v} must be >= 0")
    if meaning not in ("std", "variance"):
        raise ValueError(f"mut_v_is={meaning!r} must be 'std' or 'variance'")
    return mut_v if meaning == "std" else math.sqrt(mut_v)


def _normal(leaf: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    return torch.randn(
        leaf.shape, generator=generator, device=leaf.device, dtype=leaf.dtype
    )
