"""Policies that prepare how members act at once, against each member's policy itself."""

from __future__ import annotations

import logging
import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_torchrl.agents.networks import make_argmax_actor, make_tanh_normal_actor
from gdrl_torchrl.agents.rainbow.network import make_q_actor
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.population.actor import PopulationActor

MEMBERS, EPISODES, SIZE = 4, 30, 3
GREEDY, RANDOM = ExplorationType.DETERMINISTIC, ExplorationType.RANDOM


def ppo(low=(-1.0, -1.0), high=(1.0, 1.0), **options):
    spec = Bounded(torch.tensor(low), torch.tensor(high))
    return make_tanh_normal_actor(SIZE, spec, num_cells=(8, 6), **options)


def rainbow(**options):
    options = {"value_range": (-1.0, 2.0), "num_atoms": 7, "num_cells": (6, 5)} | options
    return make_q_actor(SIZE, 4, **options)


def argmax(**options):
    return make_argmax_actor(SIZE, Categorical(5), num_cells=(8, 6), **options)


ACTORS = {
    "ppo": ppo,
    "ppo with scaled bounds": lambda: ppo((0.0, -3.0), (2.0, -1.0)),
    "ppo with relu": lambda: ppo(activation=nn.ReLU),
    "rainbow": rainbow,
    "rainbow, streams of one layer": lambda: rainbow(num_cells=(6,)),
    "noisy rainbow": lambda: rainbow(noisy=True),
    "argmax": argmax,
    "argmax with elu": lambda: argmax(activation=nn.ELU),
}


@pytest.fixture(params=ACTORS)
def actor(request):
    return ACTORS[request.param]()


@pytest.fixture(autouse=True)
def _greedy():
    with set_exploration_type(GREEDY):
        yield


def inputs():
    generator = torch.Generator().manual_seed(3)
    observation = 2.0 * torch.randn(MEMBERS, EPISODES, SIZE, generator=generator)
    return TensorDict(observation=observation, batch_size=[MEMBERS, EPISODES])


def loaded(actor, genomes):
    population = PopulationActor(actor)
    population.load(genomes)
    return population


def act(population, **options):
    """Actions, whether they are numbers, and whether it took a graph to find them."""
    shown = inputs()
    action, finite = population.bind(shown, **options)([shown["observation"]])
    return action, finite, bool(population.graphs)


def alone(member_of, actor, genomes):
    """The oracle: what each member's policy does by itself."""
    members = [member_of(actor, genomes, number) for number in range(MEMBERS)]
    with torch.no_grad():
        acted = [m(own.clone()) for m, own in zip(members, inputs(), strict=True)]
    return torch.stack([each["action"] for each in acted])


def are_equal(one, other):
    return one.dtype == other.dtype and torch.allclose(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("parts", [1, 3])
def test_members_act_as_they_do_alone(parts, actor, population_of, member_of):
    genomes = population_of(actor, MEMBERS)
    action, finite, graph = act(loaded(actor, genomes), parts=parts)
    expected = alone(member_of, actor, genomes)
    assert are_equal(action, expected)
    assert len(expected.unique()) > 2, "actions differ"
    assert finite.all()
    assert not graph


def test_other_members_act_by_their_own_weights(actor, population_of, member_of):
    genomes = population_of(actor, MEMBERS)
    population = loaded(actor, genomes)
    act(population)
    # Not larger ones: a mean action of 160 is a sum whose rounding alone, another one on
    # every processor, is more than the bound.
    genomes = genomes * 0.5
    population.load(genomes)
    assert are_equal(act(population)[0], alone(member_of, actor, genomes))
    population.choose(torch.tensor([3, 1, 1, 0]))
    chosen = genomes[torch.tensor([3, 1, 1, 0])]
    assert are_equal(act(population)[0], alone(member_of, actor, chosen))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_member_with_a_strange_weight_is_marked_and_the_others_act(
    value, actor, population_of, member_of
):
    genomes = population_of(actor, MEMBERS)
    healthy = alone(member_of, actor, genomes)
    population = PopulationActor(actor)
    for name in genomes.keys(True, True):
        if "sigma" in name[-1]:
            continue  # a greedy policy does not read it
        broken = genomes.clone()
        broken[2][name].view(-1)[0] = value
        population.load(broken)
        action, finite, _ = act(population, parts=2)
        assert finite[[0, 1, 3]].all(), name
        assert are_equal(action[[0, 1, 3]], healthy[[0, 1, 3]]), name
        assert torch.isfinite(action.double()).all(), name
        if math.isnan(value):
            assert not finite[2].any(), name


def test_policies_that_explore_are_not_prepared(population_of):
    actor = rainbow(noisy=True)
    population = loaded(actor, population_of(actor, MEMBERS))
    greedy, *_ = act(population)
    with set_exploration_type(RANDOM):
        action, _, graph = act(population)
    assert graph
    assert not torch.equal(action, greedy)


def test_one_hot_actions_are_not_prepared(population_of, member_of):
    actor = rainbow(spec=OneHot(4))
    genomes = population_of(actor, MEMBERS)
    action, *_ = act(loaded(actor, genomes))
    assert torch.equal(action, alone(member_of, actor, genomes))


class Plain(TensorDictModule):
    """A policy of somebody else, which prepares nothing."""

    def __init__(self):
        super().__init__(nn.Linear(SIZE, 2), ["observation"], ["action"])


class Wrong(Plain):
    """A policy that has prepared something else than it does."""

    def prepared(self, params):
        weight, bias = params["module", "weight"].mT, params["module", "bias"]

        def run(observation):
            action = observation @ weight - bias[:, None]
            return action, action

        return run


class Right(Wrong):
    """A policy of somebody else that prepares what it does."""

    def prepared(self, params):
        turned = params.clone()
        turned["module", "bias"] *= -1.0
        return super().prepared(turned)


@pytest.mark.parametrize(("kind", "takes_graph"), [(Plain, True), (Right, False)])
def test_policies_of_others_may_prepare(
    kind, takes_graph, population_of, member_of, caplog
):
    actor = kind()
    genomes = population_of(actor, MEMBERS)
    action, finite, graph = act(loaded(actor, genomes))
    assert are_equal(action, alone(member_of, actor, genomes))
    assert finite.all()
    assert graph == takes_graph
    assert not caplog.records


def test_what_is_prepared_wrongly_is_noticed_and_not_used(population_of, member_of, caplog):
    actor = Wrong()
    genomes = population_of(actor, MEMBERS)
    with caplog.at_level(logging.WARNING):
        action, finite, graph = act(loaded(actor, genomes))
    assert are_equal(action, alone(member_of, actor, genomes))
    assert finite.all()
    assert graph
    assert "Wrong acts otherwise than it has prepared" in caplog.text


def test_a_member_that_is_not_a_number_does_not_win(
    evaluator_for, easy_task_for, actor_of, population_of
):
    task = easy_task_for("tanh_normal")
    actor = make_tanh_normal_actor(
        task.spec.observation_size,
        Bounded(-1.0, 1.0, shape=torch.Size([task.spec.action_size])),
    )
    genomes = population_of(actor, 3)
    genomes[1].apply_(lambda leaf: leaf.fill_(math.nan))
    evaluator = evaluator_for(actor, 6, task=task, num_episodes=2)
    fitness = evaluator.evaluate(genomes)["fitness"].flatten()
    assert fitness.nan_to_num(-math.inf).argmin() == 1
    assert torch.isfinite(fitness[[0, 2]]).all()


def test_members_with_the_actors_weights_act_as_the_actor(actor):
    population = loaded(actor, stack_copies(genome_of(actor), MEMBERS))
    with torch.no_grad():
        expected = actor(inputs().reshape(-1))["action"].unflatten(0, (MEMBERS, EPISODES))
    assert are_equal(act(population)[0], expected)
