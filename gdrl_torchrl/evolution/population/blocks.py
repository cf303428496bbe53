"""Rows of a population in blocks of one member each, fewer of them as episodes end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_ROWS = 10
"""Most rows of a block."""
_FEWEST_BLOCKS = 2
"""A batch with fewer blocks would be no faster."""
_SHRINK = 0.75
"""Each shape has about this share of the blocks of the next larger one."""
_PART_PRODUCTS = 10_000_000
"""Products of weights and rows in a part. A part takes a millisecond: long enough that
threads do not hinder each other, and small enough for the processor's cache."""


class BlockShape(NamedTuple):
    """Number of parts, of blocks in each part, and of rows in each block.

    The parts do not depend on the number of threads that run them.
    """

    parts: int
    blocks: int
    rows: int

    @property
    def count(self) -> int:
        """Number of blocks in all parts."""
        return self.parts * self.blocks


def block_shapes(members: int, trials: int, num_parameters: int) -> list[BlockShape]:
    """Every shape that a batch of acting worlds may have, the largest first.

    Args:
        members: Members of the population.
        trials: Episodes of each.
        num_parameters: Parameters of one member.

    Examples:
        >>> [shape.count for shape in block_shapes(11, 20, num_parameters=30_000)]
        [22, 16, 12, 9, 6, 4, 3, 2]
        >>> block_shapes(64, 20, num_parameters=30_000)[:3]
        [BlockShape(parts=3, blocks=43, rows=10), BlockShape(parts=2, blocks=48, rows=10),
         BlockShape(parts=2, blocks=36, rows=10)]
    """
    rows = min(trials, _ROWS)
    counts = [members * -(-trials // rows)]
    while int(_SHRINK * counts[-1]) >= _FEWEST_BLOCKS:
        counts.append(int(_SHRINK * counts[-1]))
    parts = [max(1, c * rows * num_parameters // _PART_PRODUCTS) for c in counts]
    return [BlockShape(p, -(-c // p), rows) for p, c in zip(parts, counts, strict=True)]


def blocks_needed(live: np.ndarray, trials: int, rows: int) -> int:
    """Number of blocks for all live worlds ``[L]``, each of member ``world // trials``."""
    return int((-(-np.bincount(live // trials) // rows)).sum())


def fill_blocks(
    live: np.ndarray, trials: int, shape: BlockShape
) -> tuple[np.ndarray, np.ndarray]:
    """Worlds by block ``[K, B]`` and the member of each block ``[K]``.

    Where a block has fewer worlds than rows, its first world fills it up: that world acts
    more than once, with the same result. Blocks that are not needed are filled with the
    first world of the first block.

    Args:
        live: Worlds, ascending, ``[L]``.
        trials: Worlds of a member.
        shape: The shape to fill, with enough blocks.

    Examples:
        >>> worlds, members = fill_blocks(np.array([0, 1, 2, 5]), 3, BlockShape(1, 4, 2))
        >>> worlds.tolist()
        [[0, 1], [2, 2], [5, 5], [0, 0]]
        >>> members.tolist()
        [0, 0, 1, 0]
    """
    member = live // trials
    live_of = np.bincount(member)
    blocks_of = -(-live_of // shape.rows)
    first_world, first_block = (np.cumsum(of) - of for of in (live_of, blocks_of))
    place = np.arange(len(live)) - first_world[member]
    block, slot = first_block[member] + place // shape.rows, place % shape.rows
    begins = live[slot == 0]
    worlds = np.full((shape.count, shape.rows), begins[0])
    worlds[: len(begins)] = begins[:, None]
    worlds[block, slot] = live
    return worlds, worlds[:, 0] // trials
