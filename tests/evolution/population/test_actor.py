"""A population as one batch against each member alone, unbatched."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.population.actor import PopulationActor
from tests.evolution.population.observations import EPISODES, MEMBERS, rows

pytestmark = pytest.mark.usefixtures("greedy")


def test_it_equals_running_each_member_alone(
    actor_kind, actor_of, population_of, member_of
):
    actor = actor_of(actor_kind)
    genomes = population_of(actor, MEMBERS)
    population = PopulationActor(actor)
    population.load(genomes)
    out = population(rows())
    assert out.batch_size == torch.Size([MEMBERS * EPISODES])
    assert out["policy_is_finite"].all()
    for number in range(MEMBERS):
        member = member_of(actor, genomes, number)
        for place in range(number * EPISODES, (number + 1) * EPISODES):
            with torch.no_grad():
                alone = member(rows()[place])
            for key in member.out_keys:
                assert torch.allclose(out[place][key], alone[key], atol=1e-5), key
            if not alone["action"].dtype.is_floating_point:
                assert (out["action"][place] == alone["action"]).all()


def test_the_actor_stays_as_it_was(actor_kind, actor_of, population_of):
    actor = actor_of(actor_kind)
    state = {name: value.clone() for name, value in actor.state_dict().items()}
    objects = {name: id(value) for name, value in actor.named_parameters()}
    population = PopulationActor(actor)
    population.load(population_of(actor, MEMBERS))
    population(rows())
    population.unload()
    assert {name: id(value) for name, value in actor.named_parameters()} == objects
    assert all((actor.state_dict()[n] == value).all() for n, value in state.items())
    assert all(p.requires_grad and p.grad is None for p in actor.parameters())
    assert set(actor.state_dict()) == set(state)


def test_the_population_stays_as_it_was(actor_kind, actor_of, population_of):
    actor = actor_of(actor_kind)
    genomes = population_of(actor, MEMBERS)
    before = genomes.clone()
    population = PopulationActor(actor)
    population.load(genomes)
    population(rows())
    assert (genomes == before).all()
    assert set(genomes.keys(True)) == set(before.keys(True))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_a_member_that_is_not_finite_is_marked_and_no_other_is_touched(
    value, actor_kind, actor_of, population_of
):
    actor = actor_of(actor_kind)
    genomes = population_of(actor, MEMBERS)
    population = PopulationActor(actor)
    population.load(genomes)
    healthy = population(rows())
    broken = genomes.clone()
    broken[2].apply_(lambda leaf: leaf.fill_(value))
    population.load(broken)
    out = population(rows())
    sick = torch.arange(MEMBERS * EPISODES) // EPISODES == 2
    assert (out["policy_is_finite"] == ~sick).all()
    assert torch.isfinite(out["action"].double()).all()
    for key in actor.out_keys:
        assert (out[key][~sick] == healthy[key][~sick]).all(), key


def test_what_genomes_lack_is_the_actors_own(actor_of):
    actor = actor_of("distributional")
    population = PopulationActor(actor)
    population.load(stack_copies(genome_of(actor, exclude=["bias"]), MEMBERS))
    with torch.no_grad():
        expected = actor(rows())
    assert torch.allclose(
        population(rows())["action_value"], expected["action_value"], atol=1e-6
    )


def test_later_changes_of_the_actor_do_not_reach_loaded_members(actor_of, population_of):
    actor = actor_of("tanh_normal")
    population = PopulationActor(actor)
    population.load(population_of(actor, MEMBERS))
    before = population(rows())["action"].clone()
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(1.0)
    assert (population(rows())["action"] == before).all()


def test_members_sample_apart_when_they_explore(actor_of):
    actor = actor_of("tanh_normal")
    population = PopulationActor(actor)
    population.load(stack_copies(genome_of(actor), MEMBERS))
    same = rows(EPISODES).expand(MEMBERS, EPISODES).reshape(-1).clone()
    with set_exploration_type(ExplorationType.RANDOM):
        action = population(same)["action"].reshape(MEMBERS, EPISODES, 2)
    assert (action[0] != action[1]).all()


def test_one_member_and_one_row_work(actor_kind, actor_of, population_of):
    actor = actor_of(actor_kind)
    population = PopulationActor(actor)
    population.load(population_of(actor, 1))
    with torch.no_grad():
        expected = actor(rows(1))["action"]
    assert torch.allclose(
        population(rows(1))["action"].double(), expected.double(), atol=1e-5
    )


def test_without_members_it_says_so(actor_of, population_of):
    actor = actor_of("tanh_normal")
    population = PopulationActor(actor)
    with pytest.raises(RuntimeError, match="no members are loaded"):
        population(rows())
    population.load(population_of(actor, 2))
    population.unload()
    with pytest.raises(RuntimeError, match="no members are loaded"):
        population(rows())


def test_parameters_that_are_not_the_actors_are_refused(actor_of, population_of):
    population = PopulationActor(actor_of("tanh_normal"))
    with pytest.raises(ValueError, match="fuel"):
        population.load(TensorDict(fuel=torch.zeros(3, 1), batch_size=[3]))


def test_an_actor_without_parameters_is_refused():
    actor = TensorDictModule(nn.Tanh(), in_keys=["observation"], out_keys=["action"])
    with pytest.raises(ValueError, match="no parameters"):
        PopulationActor(actor)
