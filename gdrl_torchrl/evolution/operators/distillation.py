"""Crossover of behaviour: one policy that does what several others did."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDictBase

Act = Callable[[torch.Tensor], torch.Tensor]
"""Observations ``[K, B, D]`` to greedy actions ``[K, B, A]`` of ``K`` policies."""
Bind = Callable[[TensorDictBase], Act]
"""Genomes ``[K]`` to a function of observations that can be differentiated by them, and
follows when they are changed in place."""


class Demonstration(NamedTuple):
    """What a policy saw and did in an episode."""

    observation: torch.Tensor
    """``[T, D]``."""
    action: torch.Tensor
    """``[T, A]``."""


def distil(
    bind: Bind,
    first: TensorDictBase,
    groups: Sequence[Sequence[Demonstration]],
    *,
    num_updates: int = 300,
    learning_rate: float = 1e-2,
    minibatch_size: int = 64,
    generator: torch.Generator,
) -> tuple[TensorDictBase, torch.Tensor]:
    """Fit a policy to each of several groups of demonstrations, all at once.

    The distilled crossover of Bodnar, Day and Lio (AAAI 2020,
    https://arxiv.org/abs/1906.09807), by supervised learning and without a critic: weights
    of two policies that do the same may have nothing in common, and their mean does
    neither; what they did can be learnt by a third.

    Args:
        bind: The family of policies.
        first: Weights ``[]`` that every fit starts from.
        groups: ``K`` groups of demonstrations.
        num_updates: Updates of Adam.
        learning_rate: Its step.
        minibatch_size: Steps of demonstrations in an update.
        generator: Source of randomness.

    Returns:
        Genomes ``[K]``, and the mean squared error of the actions in the last updates
        ``[K]``. Where it is large, the group's demonstrations contradict each other.

    Examples:
        >>> from tensordict import TensorDict
        >>> rows = torch.linspace(-1, 1, 20)[:, None]
        >>> shown = Demonstration(rows, 0.5 * rows)
        >>> genome = TensorDict(weight=torch.zeros(1))
        >>> fitted, error = distil(
        ...     lambda genomes: lambda x: x * genomes["weight"][:, None],
        ...     genome,
        ...     [[shown], [shown, shown]],
        ...     generator=torch.Generator().manual_seed(0),
        ... )
        >>> fitted["weight"].round(decimals=2)
        tensor([[0.5000],
                [0.5000]])
    """
    count = len(groups)
    joined = [
        Demonstration(*(torch.cat(column) for column in zip(*group, strict=True)))
        for group in groups
    ]
    # One long list of steps, of which each group has a part of its own.
    seen, done = (torch.cat(column) for column in zip(*joined, strict=True))
    lengths = torch.tensor([len(one.action) for one in joined])[:, None]
    begins = lengths.cumsum(0) - lengths
    genomes = first.expand(count, *first.batch_size).clone()
    leaves = list(genomes.values(include_nested=True, leaves_only=True))
    weights = [leaf.requires_grad_() for leaf in leaves]
    optimizer = torch.optim.Adam(weights, lr=learning_rate, fused=True)
    act = bind(genomes)
    tail = torch.zeros(count)
    num_tail = min(20, num_updates)
    with torch.enable_grad():
        for number in range(num_updates):
            drawn = torch.rand(count, minibatch_size, generator=generator)
            rows = begins + (drawn * lengths).long()
            errors = (act(seen[rows]) - done[rows]).square()
            errors = errors.mean(dim=(1, 2))
            optimizer.zero_grad()
            errors.sum().backward()
            optimizer.step()
            if number >= num_updates - num_tail:
                tail += errors.detach() / num_tail
    fitted: TensorDictBase = genomes.apply(lambda leaf: leaf.detach())
    return fitted, tail
