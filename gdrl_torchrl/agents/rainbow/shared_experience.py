"""Transitions of other policies, in an agent's replay buffer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer

STALE = ("td_error", "index", "priority_weight")
"""Entries that a buffer and a loss write into samples; new items must not have them."""


def random_share(
    transitions: TensorDictBase,
    share: float,
    generator: torch.Generator,
    *,
    at_most: int | None = None,
) -> TensorDictBase:
    """Choose a random share of transitions ``[N]``, without replacement.

    Args:
        transitions: Transitions ``[N]``.
        share: Share to keep: ``round(share * N)`` transitions.
        generator: Source of randomness.
        at_most: Most transitions to keep.

    Returns:
        Copies ``[K]``, in their old order.

    Raises:
        ValueError: If the share is outside ``[0, 1]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> rows = TensorDict(number=torch.arange(10), batch_size=[10])
        >>> random_share(rows, 0.3, torch.Generator().manual_seed(0)).batch_size
        torch.Size([3])
    """
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"share must be in [0, 1]: {share}")
    total = transitions.batch_size[0]
    count = round(share * total) if at_most is None else min(round(share * total), at_most)
    order = torch.randperm(total, generator=generator)
    return transitions[order[:count].sort().values]


def share_experience(
    buffer: TensorDictReplayBuffer,
    transitions: TensorDictBase,
    n_step: Callable[[TensorDictBase], TensorDictBase],
    share: float,
    generator: torch.Generator,
) -> int:
    """Put a random share of other policies' transitions into a buffer.

    Windows over several steps are made from whole episodes before the share is drawn;
    drawing first would join steps that did not follow each other. All transitions that
    enter get the largest priority that any item has had so far. If the share exceeds the
    buffer's capacity, a random part as large as the capacity enters.

    Args:
        buffer: A buffer of
            :func:`~gdrl_torchrl.agents.rainbow.replay.make_prioritized_buffer`.
        transitions: Whole episodes ``[T]`` or ``[W, T]``. Not modified.
        n_step: An :class:`~gdrl_torchrl.agents.rainbow.n_step.NStep`.
        share: Share of the transitions that enters.
        generator: Source of randomness.

    Returns:
        How many transitions entered.

    Raises:
        ValueError: If the share is outside ``[0, 1]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> from gdrl_torchrl.agents.rainbow.n_step import NStep
        >>> from gdrl_torchrl.agents.rainbow.replay import make_prioritized_buffer
        >>> buffer = make_prioritized_buffer(
        ...     100, alpha=0.5, beta=0.4, batch_size=4, seed=0
        ... )
        >>> ends = torch.tensor([False, True, False, True]).unsqueeze(-1)
        >>> episodes = TensorDict(
        ...     observation=torch.zeros(4, 3),
        ...     action=torch.zeros(4, dtype=torch.long),
        ...     next=TensorDict(
        ...         observation=torch.zeros(4, 3),
        ...         reward=torch.ones(4, 1),
        ...         terminated=ends,
        ...         done=ends,
        ...     ),
        ...     batch_size=[4],
        ... )
        >>> generator = torch.Generator().manual_seed(0)
        >>> share_experience(buffer, episodes, NStep(0.99, 3), 0.5, generator)
        2
    """
    windows = n_step(transitions).exclude(*STALE)
    # With more items than its capacity a buffer would write several to one place.
    sampler: Any = buffer.sampler
    chosen = random_share(windows, share, generator, at_most=sampler.max_size)
    count = chosen.batch_size[0]
    if count:  # extending by nothing is an error
        buffer.extend(chosen)
    return count
