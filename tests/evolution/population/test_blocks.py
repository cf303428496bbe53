"""Worlds in blocks of one member each, against sets and counts."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gdrl_torchrl.evolution.population.blocks import (
    block_shapes,
    blocks_needed,
    fill_blocks,
)

SIZES = st.integers(1, 40)


@given(members=SIZES, trials=SIZES, weights=st.integers(1, 100_000), data=st.data())
def test_every_live_world_acts_in_a_block_of_its_member(members, trials, weights, data):
    shapes = block_shapes(members, trials, weights)
    worlds = st.integers(0, members * trials - 1)
    live = np.array(sorted(data.draw(st.sets(worlds, min_size=1, max_size=60))))
    needed = blocks_needed(live, trials, shapes[0].rows)
    of_member = [sum(w // trials == m for w in live) for m in range(members)]
    assert needed == sum(-(-count // min(trials, 10)) for count in of_member)
    fitting = [shape for shape in shapes if shape.count >= needed]
    assert fitting, "the first shape holds all"
    for shape in fitting:
        blocks, owners = fill_blocks(live, trials, shape)
        assert blocks.shape == (shape.parts * shape.blocks, shape.rows)
        assert set(blocks.ravel()) == set(live), "all of them, and nobody else"
        assert (blocks // trials == owners[:, None]).all()


@given(members=st.integers(1, 2000), trials=SIZES, weights=st.integers(1, 1_000_000))
def test_shapes_shrink_to_a_few_blocks_and_waste_little(members, trials, weights):
    shapes = block_shapes(members, trials, weights)
    needed = members * -(-trials // shapes[0].rows)
    assert needed <= shapes[0].count < needed + shapes[0].parts
    counts = [shape.count for shape in shapes]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] <= max(3, min(counts[0], shapes[-1].parts + 2))


def test_parts_are_of_work_enough_for_a_thread():
    assert [shape.parts for shape in block_shapes(11, 20, 30_000)] == [1] * 8
    for shape in block_shapes(1024, 20, 30_000):
        work = shape.blocks * shape.rows * 30_000
        assert work >= 1e7 or shape.parts == 1
        assert work < 2.5e7
