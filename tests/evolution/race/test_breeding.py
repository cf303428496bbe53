"""Members of a race: how far they are from whom, and what they have learnt from whom."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gdrl_torchrl.evolution.operators.distillation import Demonstration
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.population.fitted import greedy_actions_of
from gdrl_torchrl.evolution.race.breeding import RaceBreeding
from gdrl_torchrl.evolution.race.candidates import Candidate
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


def test_new_members_are_far_from_the_first_weights_and_near_ones_near(breeding_of):
    breeding = breeding_of(new_std=0.86, new_rate=0.75, near_std=0.11)
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    first = flat(breeding.first)
    far = [flat(breeding.member(None, rng, generator).genome) - first for _ in range(40)]
    far = torch.stack(far)
    assert float((far != 0.0).float().mean()) == pytest.approx(0.75, abs=0.03)
    assert float(far[far != 0.0].std()) == pytest.approx(0.86, rel=0.02)
    known = Candidate(breeding.first.apply(torch.zeros_like), "new", 1, 1)
    drawn = [breeding.member(known, rng, generator) for _ in range(200)]
    near = [one for one in drawn if one is not known]
    assert 60 < len(near) < 140
    assert {one.origin for one in near} == {"near"}
    assert all(one.episodes == 0 for one in near)
    spread = torch.stack([flat(one.genome) for one in near]).std()
    assert float(spread) == pytest.approx(0.11, rel=0.02)


def test_new_members_stay_those_of_the_first_weights(actor_of):
    torch.manual_seed(0)
    actor = actor_of("tanh_normal")
    breeding = RaceBreeding(actor, RaceConfig(new_std=0.0))
    before = genome_of(actor)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(1.0)
    member = breeding.member(None, np.random.default_rng(0), torch.Generator())
    assert (member.genome == before).all()


def test_members_are_distilled_once_for_new_demonstrations(breeding_of, actor_of):
    breeding = breeding_of(num_distilled=3)
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    assert breeding.distilled(rng, generator) == []
    seen = torch.randn(50, 3, generator=generator)
    shown = Demonstration(seen, torch.stack([seen[:, 0].tanh(), -seen[:, 1].tanh()], dim=1))
    breeding.show(shown)
    members = breeding.distilled(rng, generator)
    assert [one.origin for one in members] == ["distilled"] * 3
    torch.manual_seed(0)
    bind = greedy_actions_of(actor_of("tanh_normal"))
    genomes = torch.stack([one.genome for one in members])
    found = bind(genomes)(seen.expand(3, 50, 3))
    assert float((found - shown.action).abs().mean()) < 0.05
    assert breeding.distilled(rng, generator) == []


def test_members_whose_demonstrations_contradict_each_other_are_left_out(
    breeding_of, actor_of
):
    """One demonstration in three shows the opposite: groups with both fit neither."""
    breeding = breeding_of(num_distilled=4)
    generator = torch.Generator().manual_seed(0)
    for number in range(6):
        seen = torch.randn(40, 3, generator=generator)
        sign = -1.0 if number % 3 == 2 else 1.0
        breeding.show(Demonstration(seen, sign * seen[:, :2].tanh()))
    members = breeding.distilled(np.random.default_rng(0), generator)
    assert len(members) == 4
    bind = greedy_actions_of(actor_of("tanh_normal"))
    genomes = torch.stack([one.genome for one in members])
    seen = torch.randn(40, 3, generator=generator)
    found = bind(genomes)(seen.expand(4, 40, 3))
    expected = seen[:, :2].tanh()
    errors = [(found - sign * expected).abs().mean(dim=(1, 2)) for sign in (1.0, -1.0)]
    # A group of both does neither: it is half an action from each.
    assert float(torch.minimum(*errors).max()) < 0.45


def test_a_breeding_that_distils_none_keeps_no_demonstrations(breeding_of):
    breeding = breeding_of(num_distilled=0)
    breeding.show(Demonstration(torch.zeros(2, 3), torch.zeros(2, 2)))
    assert breeding.distilled(np.random.default_rng(0), torch.Generator()) == []
    assert breeding.state_dict()["shown"] == []
