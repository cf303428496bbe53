"""Seeds of episodes: one integer each, the same however they are asked for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdrl_tasks.seeds import Stream, episode_seeds, stream_of

streams = st.sampled_from(list(Stream))


@given(streams, st.integers(0, 2**40), st.integers(0, 300), st.integers(0, 150))
def test_seeds_are_hashes_of_stream_run_and_number(stream, seed, start, count):
    found = episode_seeds(stream, seed, start, count)
    assert found.shape == (count,)
    assert found.dtype == np.int64
    assert (stream_of(found) == stream).all()
    for number, value in enumerate(found.tolist(), start):
        sequence = np.random.SeedSequence((seed, int(stream), number))
        [hashed] = sequence.generate_state(1, np.uint64).tolist()
        assert value % 2**60 == hashed % 2**60


def test_seeds_of_runs_and_streams_differ():
    drawn = [episode_seeds(stream, seed, 0, 200) for stream in Stream for seed in (0, 1, 2)]
    assert len(np.unique(drawn)) == 200 * 3 * len(Stream)


@pytest.mark.parametrize("wrong", [{"seed": -1}, {"start": -1}, {"count": -1}])
def test_negative_numbers_are_named(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}=-1 must be >= 0"):
        episode_seeds(Stream.TRAINING, **({"seed": 0, "start": 0, "count": 1} | wrong))


def test_a_seed_that_is_no_integer_is_refused():
    with pytest.raises(TypeError, match="float"):
        episode_seeds(Stream.TRAINING, 0.5, 0, 1)
