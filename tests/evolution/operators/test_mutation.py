"""Mutation: how much of a genome changes, by how much, and from which randomness."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from gdrl_torchrl.evolution.operators.mutation import MUTATIONS, standard_deviation

SHAPES = st.dictionaries(
    st.sampled_from(["a", "b", "c"]),
    st.lists(st.integers(1, 4), min_size=0, max_size=3).map(tuple),
    min_size=1,
)
reading = pytest.mark.parametrize("reading", list(MUTATIONS))


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def zeros(*shape, names=("weight",), dtype=torch.float32):
    leaves = {name: torch.zeros(shape, dtype=dtype) for name in names}
    return TensorDict(leaves, batch_size=shape[:1])


@reading
@given(
    shapes=SHAPES,
    members=st.integers(1, 4),
    mut_p=st.floats(0.0, 1.0),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
@settings(max_examples=25)
def test_structure_shapes_and_types_are_kept_and_the_input_is_not_touched(
    reading, shapes, members, mut_p, dtype
):
    genomes = TensorDict(
        {
            ("net", name): torch.randn((members, *shape), dtype=dtype)
            for name, shape in shapes.items()
        },
        batch_size=[members],
    )
    before = genomes.clone()
    mutants = MUTATIONS[reading](genomes, mut_p=mut_p, std=0.1, generator=generator())
    assert (genomes == before).all()
    assert mutants.batch_size == genomes.batch_size
    assert set(mutants.keys(True, True)) == set(genomes.keys(True, True))
    for key in genomes.keys(True, True):
        assert mutants[key].shape == genomes[key].shape
        assert mutants[key].dtype == dtype
        assert torch.isfinite(mutants[key]).all()
        assert mutants[key].data_ptr() != genomes[key].data_ptr()


@reading
@pytest.mark.parametrize(("mut_p", "std"), [(0.0, 0.1), (0.75, 0.0), (0.0, 0.0)])
def test_no_probability_or_no_noise_changes_nothing(reading, mut_p, std):
    genomes = TensorDict(weight=torch.randn(3, 5, 4), batch_size=[3])
    mutants = MUTATIONS[reading](genomes, mut_p=mut_p, std=std, generator=generator())
    assert (mutants == genomes).all()


@pytest.mark.parametrize("mut_p", [0.75, 0.4, 0.1])
@pytest.mark.parametrize(
    ("reading", "share"),
    [
        ("bernoulli", lambda p: p),
        ("pseudocode", lambda p: 1.0 - math.exp(-p)),
        ("scaled", lambda p: 1.0),
    ],
)
def test_the_share_of_weights_that_change(reading, share, mut_p):
    mutants = MUTATIONS[reading](
        zeros(4, 200, 200), mut_p=mut_p, std=0.1, generator=generator()
    )["weight"]
    for member in mutants:
        touched = float((member != 0.0).float().mean())
        assert touched == pytest.approx(share(mut_p), abs=0.01)


@pytest.mark.parametrize("std", [0.1, 0.5])
@pytest.mark.parametrize("mut_p", [0.75, 0.1])
@pytest.mark.parametrize(
    ("reading", "variance"),
    [
        # Over all weights: a share of N(0, std^2); a Poisson number of such draws; all.
        ("bernoulli", lambda p, std: p * std**2),
        ("pseudocode", lambda p, std: p * std**2),
        ("scaled", lambda p, std: (p * std) ** 2),
    ],
)
def test_the_size_of_the_noise(reading, variance, mut_p, std):
    mutants = MUTATIONS[reading](
        zeros(2, 300, 300, dtype=torch.float64), mut_p=mut_p, std=std, generator=generator()
    )["weight"]
    assert float(mutants.mean()) == pytest.approx(0.0, abs=0.01 * std)
    assert float(mutants.var()) == pytest.approx(variance(mut_p, std), rel=0.05)


def test_a_weight_that_bernoulli_chose_gets_one_normal_draw():
    mutants = MUTATIONS["bernoulli"](
        zeros(1, 400, 400), mut_p=0.3, std=0.1, generator=generator()
    )["weight"]
    noise = mutants[mutants != 0.0]
    assert float(noise.std()) == pytest.approx(0.1, rel=0.02)
    # The fourth moment of a normal variable is three times its variance squared.
    assert float((noise**4).mean() / noise.var() ** 2) == pytest.approx(3.0, rel=0.1)


def test_pseudocode_draws_a_whole_number_of_positions_for_each_leaf():
    mutants = MUTATIONS["pseudocode"](
        zeros(50, 10), mut_p=0.1, std=1.0, generator=generator()
    )["weight"]
    assert ((mutants != 0.0).sum(dim=1) == 1).all()
    assert len((mutants != 0.0).int().argmax(dim=1).unique()) > 5


@reading
def test_leaves_of_equal_size_and_members_get_noise_of_their_own(reading):
    names = ("first", "second", "third")
    mutants = MUTATIONS[reading](
        zeros(3, 100, 100, names=names), mut_p=1.0, std=1.0, generator=generator()
    )
    rows = torch.cat([mutants[name].reshape(3, -1) for name in names])
    correlation = torch.corrcoef(rows) - torch.eye(9)
    assert float(correlation.abs().max()) < 0.05


@reading
def test_the_generator_alone_decides(reading):
    genomes = zeros(3, 20, 20)
    before = torch.get_rng_state()

    def mutate(source):
        return MUTATIONS[reading](genomes, mut_p=0.5, std=0.1, generator=source)["weight"]

    same = generator(5)
    first, second = mutate(same), mutate(same)
    assert (mutate(generator(5)) == first).all()
    assert (first != second).any(), "a generator goes on"
    assert (mutate(generator(6)) != first).any()
    assert (torch.get_rng_state() == before).all(), "the global one stays"


def test_mut_v_is_a_standard_deviation_or_a_variance():
    assert standard_deviation(0.1, "std") == 0.1
    assert standard_deviation(0.1, "variance") == pytest.approx(math.sqrt(0.1))
    assert standard_deviation(0.0, "variance") == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-0.1, "std"), "mut_v=-0.1"),
        ((float("nan"), "std"), "mut_v=nan"),
        ((0.1, "sigma"), "mut_v_is='sigma'"),
    ],
)
def test_bad_noise_is_named_with_its_value(arguments, message):
    with pytest.raises(ValueError, match=message):
        standard_deviation(*arguments)
