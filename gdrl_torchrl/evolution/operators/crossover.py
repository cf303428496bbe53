"""Two parents to one child: mean, n-point and row crossover of genomes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase

from gdrl_torchrl.plugins import with_plugins


def mean_crossover(
    first: TensorDictBase, second: TensorDictBase, *, share: float
) -> TensorDictBase:
    """``share`` of the first parent and the rest of the second, weight by weight.

    The genetic soft update of Supe-RL (Marchesini, Corsi and Farinelli, ICLR 2021, with
    a share of 0.3) and the mean crossover with the best individual of Marchesini, Corsi
    and Farinelli (IROS 2021, with 0.6).

    Args:
        first: Genomes ``[P]`` or ``[]``.
        second: Genomes of the same shapes.
        share: In [0, 1].

    Returns:
        New genomes; the arguments are not modified.

    Raises:
        ValueError: If ``share`` is outside [0, 1].

    Examples:
        >>> from tensordict import TensorDict
        >>> zero, one = TensorDict(w=torch.zeros(1)), TensorDict(w=torch.ones(1))
        >>> mean_crossover(zero, one, share=0.25)["w"]
        tensor([0.7500])
    """
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"share={share} must be in [0, 1]")

    def mix(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        return torch.lerp(other, one, share)

    return first.apply(mix, second)


def n_point_crossover(
    first: TensorDictBase,
    second: TensorDictBase,
    *,
    num_points: int = 2,
    generator: torch.Generator,
) -> TensorDictBase:
    """Cut each weight matrix at random points and take the pieces by turns.

    Every parameter of every pair of parents is cut at points of its own, in the order
    of memory; which parent begins is random. Marchesini and Farinelli (AAMAS 2020)
    name it as future work, for agents that are alike.

    Args:
        first: Genomes ``[P]``; leaves ``[P, *shape]``.
        second: Genomes ``[P]``.
        num_points: Number of cuts; two may fall on one place and cancel each other.
        generator: Source of randomness.

    Returns:
        New genomes ``[P]``.

    Raises:
        ValueError: If ``num_points`` < 1.

    Examples:
        >>> from tensordict import TensorDict
        >>> zero = TensorDict(w=torch.zeros(1, 6), batch_size=[1])
        >>> one = TensorDict(w=torch.ones(1, 6), batch_size=[1])
        >>> rng = torch.Generator().manual_seed(0)
        >>> child = n_point_crossover(zero, one, num_points=1, generator=rng)["w"]
        >>> int(child.diff().abs().sum()) <= 1
        True
    """
    if num_points < 1:
        raise ValueError(f"num_points={num_points} must be >= 1")

    def cut(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        count = one.shape[0]
        size = one[0].numel()
        points = torch.randint(
            size + 1, (count, num_points, 1), generator=generator, device=one.device
        )
        begins = torch.randint(
            2, (count, 1), generator=generator, device=one.device, dtype=torch.bool
        )
        place = torch.arange(size, device=one.device)
        passed = (place >= points).sum(dim=1)
        from_first = ((passed % 2 == 0) ^ begins).reshape(one.shape)
        return torch.where(from_first, one, other)

    return first.apply(cut, second)


def row_crossover(
    first: TensorDictBase, second: TensorDictBase, *, generator: torch.Generator
) -> TensorDictBase:
    """Replace random rows of each weight matrix by the other parent's.

    The crossover of Evolutionary RL (Khadka and Tumer, NeurIPS 2018). A matrix of ``R``
    rows is visited between 0 and 2 R - 1 times, evenly; each visit takes a random row
    and, with probability 1/2, copies the second parent's row into the child. Vectors are
    treated the same, number by number. The published code also copies rows the other
    way, into a second child; only one child is made here.

    Args:
        first: Genomes ``[P]``; leaves ``[P, *shape]``.
        second: Genomes ``[P]``.
        generator: Source of randomness.

    Returns:
        New genomes ``[P]``.
    """

    def swap(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        count = one.shape[0]
        rows = one.shape[1] if one.ndim > 1 else 1
        most = max(1, 2 * rows - 1)
        visits = torch.randint(2 * rows, (count, 1), generator=generator, device=one.device)
        where = torch.randint(rows, (count, most), generator=generator, device=one.device)
        moved = torch.rand((count, most), generator=generator, device=one.device) < 0.5
        moved &= torch.arange(most, device=one.device) < visits
        from_second = torch.zeros((count, rows), dtype=torch.int64, device=one.device)
        from_second.scatter_add_(1, where, moved.long())
        mask = (from_second > 0).reshape(count, rows, *[1] * (one.ndim - 2))
        return torch.where(mask, other, one)

    return first.apply(swap, second)


def most_similar(genomes: TensorDictBase) -> torch.Tensor:
    """For each genome the index of the nearest other one, ``[P]``.

    Distance is Euclidean over all weights.

    Raises:
        ValueError: If there are fewer than two genomes.

    Examples:
        >>> from tensordict import TensorDict
        >>> most_similar(TensorDict(w=torch.tensor([[0.0], [9.0], [1.0]]), batch_size=[3]))
        tensor([2, 2, 0])
    """
    count = genomes.batch_size[0]
    if count < 2:
        raise ValueError(f"genomes={count} must be 2 or more to have neighbours")
    leaves = genomes.values(include_nested=True, leaves_only=True)
    flat = torch.cat([leaf.reshape(count, -1) for leaf in leaves], dim=1)
    distances = torch.cdist(flat, flat)
    return distances.fill_diagonal_(torch.inf).argmin(dim=1)


def cross_with_neighbours(
    genomes: TensorDictBase, *, num_points: int, generator: torch.Generator
) -> TensorDictBase:
    """N-point crossover of each genome with the one that is most like it, ``[P]``."""
    if genomes.batch_size[0] < 2:
        return genomes
    partners = genomes[most_similar(genomes)]
    return n_point_crossover(genomes, partners, num_points=num_points, generator=generator)


def no_crossover(
    genomes: TensorDictBase, *, num_points: int, generator: torch.Generator
) -> TensorDictBase:
    """Return the genomes unchanged."""
    return genomes


CROSSOVERS: dict[str, Callable[..., TensorDictBase]] = {
    "none": no_crossover,
    "n_point": cross_with_neighbours,
}
"""Crossovers of children after their mutation, by name."""


def crossovers() -> dict[str, Callable[..., TensorDictBase]]:
    """All crossovers by name: ours, and those of other packages (``gdrl.crossovers``).

    Examples:
        >>> sorted(crossovers())[:2]
        ['n_point', 'none']
    """
    return with_plugins(CROSSOVERS, "gdrl.crossovers", needs=("__call__",))
