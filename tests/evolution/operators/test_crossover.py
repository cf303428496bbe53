"""Crossover: what children have of their parents, and how much."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from gdrl_torchrl.evolution.operators.crossover import (
    CROSSOVERS,
    mean_crossover,
    most_similar,
    n_point_crossover,
    row_crossover,
)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def parents(members, *shape):
    """One parent is all zeros and one is all ones, so that a child shows its origin."""
    size = [members]
    zero = TensorDict({("net", "w"): torch.zeros(members, *shape)}, batch_size=size)
    return zero, zero.clone().apply(lambda leaf: leaf + 1.0)


def weights(child):
    return child["net", "w"]


@given(share=st.floats(0.0, 1.0), members=st.integers(1, 3))
def test_the_mean_has_a_share_of_each_parent(share, members):
    torch.manual_seed(0)
    first = TensorDict(w=torch.randn(members, 4, 3), batch_size=[members])
    second = TensorDict(w=torch.randn(members, 4, 3), batch_size=[members])
    child = mean_crossover(first, second, share=share)["w"]
    expected = share * first["w"] + (1.0 - share) * second["w"]
    assert torch.allclose(child, expected, atol=1e-6)


def test_shares_at_the_ends_are_the_parents_themselves():
    first, second = parents(2, 3)
    assert (mean_crossover(first, second, share=1.0) == first).all()
    assert (mean_crossover(first, second, share=0.0) == second).all()


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_a_share_outside_its_range_is_refused(share):
    with pytest.raises(ValueError, match="share"):
        mean_crossover(*parents(1, 2), share=share)


@given(
    points=st.integers(1, 5),
    shape=st.sampled_from([(1,), (7,), (3, 4), (2, 3, 2)]),
    seed=st.integers(0, 99),
)
@settings(max_examples=60)
def test_n_points_make_at_most_n_changes_of_parent(points, shape, seed):
    first, second = parents(4, *shape)
    child = n_point_crossover(first, second, num_points=points, generator=generator(seed))
    flat = weights(child).reshape(4, -1)
    assert ((flat == 0) | (flat == 1)).all()
    assert (flat.diff(dim=1).abs().sum(dim=1) <= points).all()
    assert weights(first).sum() == 0.0, "parents stay"


def test_n_point_children_are_half_of_each_parent_and_cuts_are_everywhere():
    first, second = parents(4000, 9)
    flat = weights(n_point_crossover(first, second, num_points=1, generator=generator()))
    assert abs(float(flat.mean()) - 0.5) < 0.02
    # A single cut is at one of the ten places from before the first to after the last.
    where = flat.diff(dim=1).abs()
    assert torch.allclose(where.mean(dim=0), torch.full((8,), 0.1), atol=0.02)


def expected_share_of_rows(rows):
    """Of rows that a plain loop over visits replaces, averaged over counts of visits."""
    total = 0.0
    for visits in range(2 * rows):
        total += 1.0 - (1.0 - 0.5 / rows) ** visits
    return total / (2 * rows)


@pytest.mark.parametrize("shape", [(5, 3), (5,), (1, 4)])
def test_rows_move_whole_and_as_often_as_erl_moves_them(shape):
    first, second = parents(6000, *shape)
    child = weights(row_crossover(first, second, generator=generator()))
    rows = child.reshape(6000, shape[0], -1)
    assert ((rows == rows[..., :1]).all(dim=-1)).all(), "rows are moved whole"
    share = float(rows[..., 0].mean())
    assert abs(share - expected_share_of_rows(shape[0])) < 0.02


@pytest.mark.parametrize("operator", [n_point_crossover, row_crossover])
def test_the_same_generator_gives_the_same_children(operator):
    torch.manual_seed(1)
    first, second = parents(3, 4, 4)
    one, other = (operator(first, second, generator=generator(5)) for _ in range(2))
    assert (one == other).all()
    assert not (operator(first, second, generator=generator(6)) == one).all()


@given(
    points=st.lists(
        st.tuples(st.integers(-9, 9), st.integers(-9, 9)),
        min_size=2,
        max_size=6,
        unique=True,
    )
)
def test_the_most_similar_is_the_nearest_of_all_others(points):
    values = torch.tensor(points, dtype=torch.float64)
    genomes = TensorDict(x=values[:, :1], y=values[:, 1:], batch_size=[len(points)])
    found = most_similar(genomes).tolist()
    for i, j in enumerate(found):
        gaps = {
            k: (points[i][0] - points[k][0]) ** 2 + (points[i][1] - points[k][1]) ** 2
            for k in range(len(points))
            if k != i
        }
        assert j in gaps
        assert gaps[j] <= min(gaps.values()) + 1e-9


@pytest.mark.parametrize("name", CROSSOVERS)
@pytest.mark.parametrize("members", [1, 2, 7])
def test_every_registered_crossover_keeps_structure_and_arguments(name, members):
    genomes = TensorDict(
        {("net", "weight"): torch.randn(members, 3, 2), "bias": torch.randn(members, 3)},
        batch_size=[members],
    )
    before = genomes.clone()
    out = CROSSOVERS[name](genomes, num_points=2, generator=generator())
    assert (genomes == before).all()
    assert out.batch_size == genomes.batch_size
    assert set(out.keys(True, True)) == set(genomes.keys(True, True))
    # A crossover invents nothing: every weight is some genome's at that place.
    for key in genomes.keys(True, True):
        same = out[key][:, None] == genomes[key][None]
        assert same.any(dim=1).all()
