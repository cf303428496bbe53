"""Episode seeds: one integer names one world.

A seed's top bits name the stream that it belongs to, so that episodes of training, of
fitness and of held-out evaluation can never coincide.
"""

from __future__ import annotations

import enum
import functools
import secrets
from operator import index

import numpy as np

_STREAM_SHIFT = 60
_VALUE_MASK = (1 << _STREAM_SHIFT) - 1
_BLOCK = 64


class Stream(enum.IntEnum):
    """What an episode is for."""

    TRAINING = 0
    FITNESS = 1
    EVALUATION = 2
    CONTROLLER = 3
    """Hand-written and untrained controllers that measure how hard a task is."""


def episode_seeds(stream: Stream, seed: int, start: int, count: int) -> np.ndarray:
    """Seeds of episodes ``start`` to ``start + count`` of a stream, int64 ``[count]``.

    Args:
        stream: What the episodes are for.
        seed: Seed of the run.
        start: Number of the first episode.
        count: How many.

    Raises:
        ValueError: If ``seed``, ``start`` or ``count`` is negative.

    Examples:
        >>> a = episode_seeds(Stream.TRAINING, seed=0, start=0, count=3)
        >>> b = episode_seeds(Stream.TRAINING, seed=0, start=1, count=2)
        >>> bool((a[1:] == b).all())
        True
        >>> stream_of(a).tolist()
        [0, 0, 0]
    """
    for name, value in (("seed", seed), ("start", start), ("count", count)):
        if value < 0:
            raise ValueError(f"{name}={value} must be >= 0")
    blocks = [divmod(number, _BLOCK) for number in range(start, start + count)]
    seeds = [_block_of_seeds(int(stream), index(seed), block)[i] for block, i in blocks]
    return np.array(seeds, dtype=np.int64)


def fresh_seed() -> int:
    """A seed that differs every time, in [0, 2**63): from the system's entropy."""
    return secrets.randbits(63)


@functools.lru_cache(maxsize=64)
def _block_of_seeds(stream: int, seed: int, block: int) -> list[int]:
    """Neighbouring seeds. To make one alone takes ten times its share of a block."""
    tag = stream << _STREAM_SHIFT
    sequences = (
        np.random.SeedSequence((seed, stream, block * _BLOCK + i)) for i in range(_BLOCK)
    )
    return [
        tag | (int(sequence.generate_state(1, np.uint64)[0]) & _VALUE_MASK)
        for sequence in sequences
    ]


def stream_of(seeds: np.ndarray) -> np.ndarray:
    """Streams that episode seeds belong to, ``[K]``."""
    return np.asarray(seeds) >> _STREAM_SHIFT
