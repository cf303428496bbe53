"""Acting by traced graphs, whole and in parts: as the modules of a policy do."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.population.actor import PopulationActor
from tests.evolution.population.observations import EPISODES, rows

pytestmark = pytest.mark.usefixtures("greedy")


def outputs(population, rows):
    out = population(rows.clone())
    return {key: out[key] for key in out.keys(True, True)}


def test_a_traced_part_gives_what_the_modules_give(actor_kind, actor_of, population_of):
    actor = actor_of(actor_kind)
    genomes = population_of(actor, 3)
    traced, plain = PopulationActor(actor), PopulationActor(actor, trace=False)
    for members in (genomes, genomes.apply(lambda value: 2.0 * value), genomes[:2]):
        traced.load(members), plain.load(members)
        for episodes in (1, 4):
            rows = TensorDict(
                observation=torch.randn(len(members) * episodes, 3),
                batch_size=[len(members) * episodes],
            )
            mine, other = outputs(traced, rows), outputs(plain, rows)
            assert mine.keys() == other.keys()
            for key, value in mine.items():
                assert torch.equal(value, other[key]), key
    assert all(graph is not None for graph in traced.graphs.values())
    assert len(traced.graphs) == 4, "a graph a shape, whatever the members"


def test_what_does_not_evolve_is_read_anew_at_every_load(actor_of, population_of):
    actor = actor_of("distributional")
    population = PopulationActor(actor)
    rows = TensorDict(observation=torch.randn(6, 3), batch_size=[6])
    genomes = population_of(actor, 2).select(("module", "0", "module", "features"))
    before = None
    for _ in range(2):
        population.load(genomes)
        now = population(rows.clone())["action_value"]
        assert before is None or not torch.allclose(now, before)
        before = now
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter.mul_(1.5)


def actions(population, inputs, **options):
    """What the members do, and whether their outputs are numbers."""
    # Bound to other numbers than it is called with.
    act = population.bind(inputs.apply(torch.rand_like), **options)
    return act([inputs["observation"]])


@pytest.mark.parametrize("parts", [2, 3, 5])
def test_parts_on_threads_act_as_the_whole_does(parts, actor_kind, actor_of, population_of):
    actor = actor_of(actor_kind)
    population = PopulationActor(actor)
    inputs = rows(5 * EPISODES).reshape(5, EPISODES)
    with ThreadPoolExecutor(2) as pool:
        for scale in (1.0, 2.0):
            population.load(population_of(actor, 5) * scale)
            action, finite = actions(population, inputs)
            for run_all in (map, pool.map):
                same = actions(population, inputs, parts=parts, run_all=run_all)
                assert torch.equal(same[0], action)
                assert torch.equal(same[1], finite)
    # TorchRL's head of distributions cannot be traced: the whole acts then.
    if actor_kind != "distributional":
        assert None not in population.graphs.values()


def test_parts_mark_a_member_that_is_not_finite(actor_kind, actor_of, population_of):
    actor = actor_of(actor_kind)
    genomes = population_of(actor, 4)
    genomes[2].apply_(lambda leaf: leaf.fill_(float("nan")))
    population = PopulationActor(actor)
    population.load(genomes)
    inputs = rows(4 * EPISODES).reshape(4, EPISODES)
    _, finite = actions(population, inputs, parts=2)
    assert finite.all(dim=1).tolist() == [True, True, False, True]


class Shaken(nn.Module):
    """A network that is random, whatever the mode."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(3, 2)

    def forward(self, observation):
        value = self.layer(observation)
        return value + torch.randn_like(value)


def test_a_random_policy_stays_random():
    actor = TensorDictModule(Shaken(), ["observation"], ["action"])
    population = PopulationActor(actor)
    population.load(stack_copies(genome_of(actor), 2))
    rows = TensorDict(observation=torch.zeros(4, 3), batch_size=[4])
    one, other = (population(rows.clone())["action"] for _ in range(2))
    assert (one != other).all()
    assert (one[:2] != one[2:]).all(), "members draw numbers of their own"
    assert None not in population.graphs.values()
    inputs = rows.reshape(2, 2)

    def draw(run_all):
        torch.manual_seed(0)
        return actions(population, inputs, parts=2, run_all=run_all)[0]

    def backwards(function, *each):
        return [function(*one) for one in reversed([*zip(*each, strict=True)])][::-1]

    assert torch.equal(draw(map), draw(backwards)), "in order, whoever runs them"
    assert (draw(map)[0] != draw(map)[1]).all()


class Counting(nn.Module):
    """A network with a state that is no tensor."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(3, 2)
        self.calls = 0

    def forward(self, observation):
        self.calls += 1
        return self.layer(observation) * self.calls


def test_a_policy_with_a_state_in_python_is_seen_to_change():
    actor = TensorDictModule(Counting(), ["observation"], ["action"])
    population = PopulationActor(actor)
    population.load(stack_copies(genome_of(actor), 2))
    rows = TensorDict(observation=torch.ones(4, 3), batch_size=[4])
    one, other = (population(rows.clone())["action"] for _ in range(2))
    assert not torch.allclose(one, other)


def test_a_state_in_python_is_each_members_own():
    actor = TensorDictModule(Counting(), ["observation"], ["action"])
    population = PopulationActor(actor)
    population.load(stack_copies(genome_of(actor), 2))
    rows = TensorDict(observation=torch.ones(4, 3), batch_size=[4])
    with torch.no_grad():
        once = actor.module.layer(torch.ones(3))
    for calls in (1, 2, 3):
        assert torch.allclose(population(rows.clone())["action"], calls * once)
    assert actor.module.calls == 0, "the actor itself is not called"
    population.load(stack_copies(genome_of(actor), 2))
    assert torch.allclose(population(rows.clone())["action"], once), "begun anew"
