"""Members of a race: how far they are from whom, and what they have learnt from whom."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.population.fitted import greedy_actions_of
from gdrl_torchrl.evolution.race.breeding import RaceBreeding
from gdrl_torchrl.evolution.settings import RaceConfig


@pytest.fixture
def breeding_of(actor_of):
    def make(**settings):
        torch.manual_seed(0)
        return RaceBreeding(actor_of("tanh_normal"), RaceConfig(**settings))

    return make


def flat(genome):
    leaves = genome.values(include_nested=True, leaves_only=True)
    return torch.cat([leaf.flatten() for leaf in leaves])


def test_new_members_are_far_from_the_first_weights(breeding_of):
    breeding = breeding_of(new_std=0.86, new_rate=0.75)
    first = flat(breeding.first)
    members = breeding.new(40, torch.Generator().manual_seed(0))
    assert {(one.origin, one.episodes) for one in members} == {("new", 0)}
    far = torch.stack([flat(one.genome) - first for one in members])
    assert float((far != 0.0).float().mean()) == pytest.approx(0.75, abs=0.03)
    assert float(far[far != 0.0].std()) == pytest.approx(0.86, rel=0.02)
    assert breeding.new(0, torch.Generator()) == []


def test_new_members_stay_those_of_the_first_weights(actor_of):
    torch.manual_seed(0)
    actor = actor_of("tanh_normal")
    breeding = RaceBreeding(actor, RaceConfig(new_std=0.0))
    before = genome_of(actor)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(1.0)
    [member] = breeding.new(1, torch.Generator())
    assert (member.genome == before).all()


def teacher(actor, slope):
    """A policy whose first action follows the first of three observations."""
    genome = genome_of(actor).apply(torch.zeros_like)
    layers = [leaf for leaf in genome.values(True, True) if leaf.ndim == 2]
    # The first unit of each layer passes it on.
    for number, weight in enumerate(layers):
        weight[0, 0] = slope if number == 0 else 1.0
    return genome


def test_members_do_what_the_winners_would_have_done_without_noise(breeding_of, actor_of):
    breeding = breeding_of(num_distilled=3)
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    shown = teacher(actor_of("tanh_normal"), 1.0)
    bind = greedy_actions_of(actor_of("tanh_normal"))
    breeding.show(shown, torch.randn(60, 3, generator=generator))
    assert breeding.distilled(rng, generator) == [], "one episode is not enough"
    breeding.show(shown, torch.randn(40, 3, generator=generator))
    [member] = breeding.distilled(rng, generator)
    assert (member.origin, member.episodes) == ("distilled", 0)
    seen = torch.randn(50, 3, generator=generator)
    expected = bind(shown[None])(seen[None])
    assert float(expected.std()) > 0.2
    found = bind(member.genome[None])(seen[None])
    assert float((found - expected).detach().abs().mean()) < 0.05


@pytest.mark.parametrize(("shown", "groups"), [(2, 1), (3, 4), (4, 11), (5, 25)])
def test_no_group_of_episodes_is_drawn_twice(breeding_of, shown, groups):
    """Two to four of so many episodes: as many members as there are such groups."""
    breeding = breeding_of(num_distilled=16, distillation_updates=1)
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    for _ in range(shown):
        breeding.show(breeding.first, torch.randn(5, 3, generator=generator))
    members = sum(len(breeding.distilled(rng, generator)) for _ in range(40))
    assert members == groups
    # With another episode there are others.
    breeding.show(breeding.first, torch.randn(5, 3, generator=generator))
    assert breeding.distilled(rng, generator)


def test_groups_of_demonstrations_differ(breeding_of, actor_of):
    """Of eight episodes four show the opposite: members differ in whom they follow."""
    breeding = breeding_of(num_distilled=8, distillation_updates=300)
    generator = torch.Generator().manual_seed(0)
    for slope in (1.0, -1.0) * 4:
        shown = teacher(actor_of("tanh_normal"), slope)
        breeding.show(shown, torch.randn(40, 3, generator=generator))
    members = breeding.distilled(np.random.default_rng(0), generator)
    bind = greedy_actions_of(actor_of("tanh_normal"))
    seen = torch.linspace(-2, 2, 41)[:, None].expand(41, 3)
    genomes = torch.stack([one.genome for one in members])
    found = bind(genomes)(seen.expand(len(members), 41, 3))
    slopes = (found[:, -1, 0] - found[:, 0, 0]).detach()
    assert float(slopes.max()) > 0.3
    assert float(slopes.min()) < -0.3


def test_the_number_of_distilled_members_is_at_most_that_of_all(breeding_of, actor_of):
    breeding = breeding_of(num_distilled=9, num_members=4, distillation_updates=2)
    for _ in range(10):
        breeding.show(teacher(actor_of("tanh_normal"), 1.0), torch.zeros(5, 3))
    members = breeding.distilled(np.random.default_rng(0), torch.Generator())
    assert len(members) == 4


def test_a_breeding_that_distils_none_keeps_no_demonstrations(breeding_of):
    breeding = breeding_of(num_distilled=0)
    for _ in range(3):
        breeding.show(breeding.first, torch.zeros(2, 3))
    assert breeding.distilled(np.random.default_rng(0), torch.Generator()) == []
    assert breeding.state_dict()["shown"] == []
