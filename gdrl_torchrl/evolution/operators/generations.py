"""From one generation to the next: the steps of Evolutionary RL and of the plain GA.

Pure functions of a population ``[P]`` and its fitness ``[P]``. NaN ranks last.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from gdrl_torchrl.evolution.operators.crossover import row_crossover
from gdrl_torchrl.evolution.operators.genome import concatenate
from gdrl_torchrl.evolution.operators.selection import rank_scores


def ranking(fitness: torch.Tensor, returns: torch.Tensor | None = None) -> torch.Tensor:
    """Members from best to worst, ``[P]``; ties by return, then by index.

    Examples:
        >>> ranking(torch.tensor([1.0, float("nan"), 3.0, 1.0])).tolist()
        [2, 0, 3, 1]
        >>> ranking(torch.tensor([1.0, 1.0]), torch.tensor([0.2, 0.5])).tolist()
        [1, 0]
    """
    order = torch.arange(len(fitness), device=fitness.device)
    for scores in (returns, fitness):
        if scores is not None:
            by = rank_scores(scores.reshape(-1))[order]
            order = order[by.argsort(descending=True, stable=True)]
    return order


def tournament(
    order: torch.Tensor, count: int, *, size: int, generator: torch.Generator
) -> torch.Tensor:
    """Winners of tournaments, with replacement, ``[count]``.

    Args:
        order: Members from best to worst, ``[P]``.
        count: Number of tournaments.
        size: Members that are drawn for each.
        generator: Source of randomness.

    Raises:
        ValueError: If ``size`` < 1.

    Examples:
        >>> rng = torch.Generator().manual_seed(0)
        >>> tournament(torch.tensor([2, 0, 1]), 4, size=50, generator=rng).tolist()
        [2, 2, 2, 2]
    """
    if size < 1:
        raise ValueError(f"size={size} must be >= 1")
    drawn = torch.randint(
        len(order), (count, size), generator=generator, device=order.device
    )
    return order[drawn.min(dim=1).values]


def erl_mutation(
    genomes: TensorDictBase,
    *,
    generator: torch.Generator,
    strength: float = 0.1,
    share: float = 0.1,
    super_probability: float = 0.05,
    super_strength: float = 10.0,
    reset_probability: float = 0.05,
) -> TensorDictBase:
    """The mutation of Evolutionary RL (Khadka and Tumer, NeurIPS 2018, algorithm 3).

    Each weight matrix of each genome mutates with a probability of its own, which is
    twice a uniform number. Then between none and ``share`` of its weights change, evenly
    drawn: mostly by a factor 1 + N(0, strength^2), rarely by 1 + N(0, super_strength^2),
    and as rarely to a new N(0, 1). Vectors (biases) do not change. The published code
    draws positions with replacement; here each is drawn once.

    Args:
        genomes: ``[P]``; leaves ``[P, *shape]``.
        generator: Source of randomness.
        strength: Relative standard deviation of a usual mutation.
        share: Largest share of a matrix's weights that mutates.
        super_probability: Probability that a mutation is a super mutation.
        super_strength: Relative standard deviation of a super mutation.
        reset_probability: Probability that a mutation is a reset.

    Returns:
        New genomes ``[P]``.
    """

    def mutate(leaf: torch.Tensor) -> torch.Tensor:
        if leaf.ndim < 3:
            return leaf.clone()
        count, size = leaf.shape[0], leaf[0].numel()
        flat = leaf.reshape(count, size)

        def uniform(*shape: int) -> torch.Tensor:
            return torch.rand(shape, generator=generator, device=leaf.device)

        chosen = uniform(count, 1) < 2.0 * uniform(count, 1)
        most = -int(-share * size // 1)
        numbers = torch.randint(
            max(most, 1), (count, 1), generator=generator, device=leaf.device
        )
        # The ranks of random numbers are a random order of the positions.
        ranks = uniform(count, size).argsort(dim=1).argsort(dim=1)
        mutates = chosen & (ranks < numbers)
        kind = uniform(count, size)
        is_super = kind < super_probability
        is_reset = ~is_super & (kind < super_probability + reset_probability)
        noise = torch.randn(
            (count, size), generator=generator, device=leaf.device, dtype=leaf.dtype
        )
        factor = torch.where(is_super, super_strength, strength)
        changed = torch.where(is_reset, noise, flat * (1.0 + noise * factor))
        return torch.where(mutates, changed, flat).reshape(leaf.shape)

    return genomes.apply(mutate)


def next_erl_generation(
    population: TensorDictBase,
    order: torch.Tensor,
    *,
    num_elites: int,
    tournament_size: int,
    mutation_probability: float,
    generator: torch.Generator,
) -> TensorDictBase:
    """Unchanged elites first, then crossed and mutated members, ``[P]``.

    As in Evolutionary RL (Khadka and Tumer, NeurIPS 2018, algorithm 1): the other
    places go to tournament winners, each of which is crossed with a random elite and
    then mutates with ``mutation_probability``.

    Args:
        population: Genomes ``[P]``.
        order: Its members from best to worst, ``[P]``.
        num_elites: Members that go on unchanged.
        tournament_size: Members drawn for a tournament.
        mutation_probability: Probability that a genome mutates, if it is no elite.
        generator: Source of randomness.

    Raises:
        ValueError: If there are not between 1 and P - 1 elites.
    """
    count = population.batch_size[0]
    if not 1 <= num_elites < count:
        raise ValueError(f"num_elites={num_elites} must be in [1, {count - 1}]")
    elites = order[:num_elites]
    others = count - num_elites
    winners = tournament(order, others, size=tournament_size, generator=generator)
    mates = elites[torch.randint(num_elites, (others,), generator=generator)]
    parents = population[winners]
    children = row_crossover(parents, population[mates], generator=generator)
    mutated = erl_mutation(children, generator=generator)
    mutates = torch.rand(others, generator=generator) < mutation_probability

    def choose(new: torch.Tensor, old: torch.Tensor) -> torch.Tensor:
        return torch.where(mutates.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    return concatenate([population[elites].clone(), mutated.apply(choose, children)])


def next_truncated_generation(
    population: TensorDictBase,
    order: torch.Tensor,
    *,
    elite: int,
    num_parents: int,
    std: float,
    generator: torch.Generator,
) -> TensorDictBase:
    """The unchanged elite first, then mutated copies of the best members, ``[P]``.

    The genetic algorithm of Such et al. 2017 (https://arxiv.org/abs/1712.06567,
    algorithm 1): truncation selection, mutation of every weight by N(0, std^2), no
    crossover.

    Args:
        population: Genomes ``[P]``.
        order: Its members from best to worst, ``[P]``.
        elite: Index of the member that goes on unchanged.
        num_parents: Best members that children are made of, each equally likely.
        std: Standard deviation of the mutation, in weight units.
        generator: Source of randomness.

    Raises:
        ValueError: If ``num_parents`` is not between 1 and P.
    """
    count = population.batch_size[0]
    if not 1 <= num_parents <= count:
        raise ValueError(f"num_parents={num_parents} must be in [1, {count}]")
    drawn = torch.randint(num_parents, (count - 1,), generator=generator)
    parents: Any = population[order[:num_parents][drawn]]
    children = parents.apply(
        lambda leaf: leaf + std * torch.randn(leaf.shape, generator=generator)
    )
    return concatenate([population[elite : elite + 1].clone(), children])
