"""What a prioritised replay buffer's draws depend on, to be saved and loaded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer


def buffer_state(buffer: TensorDictReplayBuffer) -> dict[str, Any]:
    """Copy all that a buffer's draws depend on: items, priorities, cursor, randomness.

    The buffer's own ``state_dict`` has the segment trees as C++ objects, which only
    pickle can write, and the unused part of the storage.

    Args:
        buffer: A buffer of
            :func:`~gdrl_torchrl.agents.rainbow.replay.make_prioritized_buffer`.

    Returns:
        Nested dicts of tensors and plain values.

    Examples:
        >>> from gdrl_torchrl.agents.rainbow.replay import make_prioritized_buffer
        >>> options = {"alpha": 0.5, "beta": 0.4, "batch_size": 4}
        >>> buffer = make_prioritized_buffer(100, seed=0, **options)
        >>> _ = buffer.extend(TensorDict(observation=torch.rand(9, 3), batch_size=[9]))
        >>> other = make_prioritized_buffer(100, seed=1, **options)
        >>> load_buffer_state(other, buffer_state(buffer))
        >>> bool((buffer.sample() == other.sample()).all())
        True
    """
    sampler: Any = buffer.sampler
    count = len(buffer)
    items = buffer.storage[:count].clone() if count else TensorDict()
    rows = torch.arange(count)
    return {
        "items": items.to_dict(),
        "count": count,
        "priorities": torch.as_tensor(sampler._sum_tree[rows]) if count else None,
        # A value and an index, or None and None.
        "max_priority": [_plain(value) for value in sampler._max_priority],
        "alpha": sampler.alpha,
        "beta": sampler.beta,
        "capacity": sampler.max_size,
        "writer": dict(buffer.writer.state_dict()),
        "generator": _generator(buffer).get_state(),
    }


def load_buffer_state(buffer: TensorDictReplayBuffer, state: Mapping[str, Any]) -> None:
    """Return a buffer to a state of :func:`buffer_state`.

    Args:
        buffer: A buffer with the same capacity and exponent ``alpha``; its items are
            replaced.
        state: The state.

    Raises:
        ValueError: If capacity or ``alpha`` differ.
    """
    sampler: Any = buffer.sampler
    own = {"capacity": sampler.max_size, "alpha": sampler.alpha}
    for name, value in own.items():
        if state[name] != value:
            raise ValueError(f"{name} is {value}, that of the state {state[name]}")
    buffer.empty()
    count = state["count"]
    if count:
        items = TensorDict(state["items"], batch_size=[count])
        # Not through the writer, which would count these items as new ones.
        rows: Any = torch.arange(count)
        buffer.storage.set(rows, items)
        # The leaves determine the trees: every node is recomputed from its children.
        sampler._sum_tree[rows] = state["priorities"]
        sampler._min_tree[rows] = state["priorities"]
    buffer.writer.load_state_dict(dict(state["writer"]))
    sampler._max_priority = tuple(state["max_priority"])
    sampler.beta = state["beta"]
    _generator(buffer).set_state(state["generator"].to(torch.uint8))


def _generator(buffer: TensorDictReplayBuffer) -> torch.Generator:
    generator: Any = buffer._rng
    if generator is None:
        raise ValueError("the buffer has no generator: make it by make_prioritized_buffer")
    return generator


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, torch.Tensor) else value
