"""What happens in a policy stays in its copy."""

from __future__ import annotations

import math
import threading

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Categorical
from torchrl.modules import QValueActor

from gdrl_torchrl.evolution.operators.genome import genome_of, install, stack_copies
from gdrl_torchrl.evolution.population.actor import PopulationActor
from tests.evolution.population.observations import rows

pytestmark = pytest.mark.usefixtures("greedy")


class Failing(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer, self.fails = nn.Linear(3, 2), False

    def forward(self, observation):
        if self.fails:
            raise RuntimeError("out of order")
        return self.layer(observation)


class Listing(nn.Module):
    """Takes numbers out of torch, which the recorder refuses."""

    def __init__(self, take):
        super().__init__()
        self.layer, self.take, self.factor = nn.Linear(3, 2), take, torch.tensor([2.0])

    def forward(self, observation):
        return self.layer(observation) * self.take(self.factor)


def to_list(tensor):
    return tensor.tolist()[0]


def to_numpy(tensor):
    return float(tensor.numpy()[0])


def as_it_was(actor):
    names = {name: id(parameter) for name, parameter in actor.named_parameters()}
    state = {name: value.clone() for name, value in actor.state_dict().items()}

    def check():
        assert {name: id(p) for name, p in actor.named_parameters()} == names
        assert actor.state_dict().keys() == state.keys()
        assert all(torch.equal(actor.state_dict()[n], value) for n, value in state.items())

    return check


def test_an_exception_in_a_policy_is_told_and_leaves_it_as_it_was():
    actor = TensorDictModule(Failing(), ["observation"], ["action"])
    check = as_it_was(actor)
    population = PopulationActor(actor)
    population.load(stack_copies(genome_of(actor), 2))
    population(rows(4))
    actor.module.fails = True
    population.load(stack_copies(genome_of(actor), 2))
    with pytest.raises(RuntimeError, match="out of order"):
        population(rows(4))
    actor.module.fails = False
    check()
    assert actor(rows(4))["action"].requires_grad
    population.load(stack_copies(genome_of(actor), 2))
    assert torch.allclose(population(rows(4))["action"], actor(rows(4))["action"])


@pytest.mark.parametrize("take", [to_list, to_numpy])
def test_a_policy_that_is_not_traced_is_left_as_it_was(take):
    actor = TensorDictModule(Listing(take), ["observation"], ["action"])
    check = as_it_was(actor)
    population = PopulationActor(actor)
    population.load(stack_copies(genome_of(actor), 2))
    acted = population(rows(4))["action"]
    check()
    assert torch.allclose(acted, actor(rows(4))["action"])


def test_tied_weights_act_as_they_are_installed():
    class Tied(nn.Module):
        def __init__(self):
            super().__init__()
            self.one, self.other = nn.Linear(3, 3), nn.Linear(3, 3)
            self.other.weight = self.one.weight

        def forward(self, observation):
            return self.other(torch.tanh(self.one(observation)))

    actor = TensorDictModule(Tied(), ["observation"], ["action"])
    genomes = stack_copies(genome_of(actor), 2)
    genomes.apply_(lambda leaf: leaf.add_(torch.randn_like(leaf)))
    for trace in (True, False):
        population = PopulationActor(actor, trace=trace)
        population.load(genomes)
        scored = population(rows(4))["action"]
        for number in range(2):
            install(actor, genomes[number])
            part = slice(2 * number, 2 * number + 2)
            assert torch.allclose(scored[part], actor(rows(4)[part])["action"], atol=1e-6)


@pytest.mark.parametrize("trace", [True, False])
def test_modes_and_attributes_are_followed_at_every_load(trace):
    network = nn.Sequential(nn.Linear(3, 8), nn.Dropout(0.5), nn.Linear(8, 2))
    actor = TensorDictModule(network, ["observation"], ["action"]).eval()
    population = PopulationActor(actor, trace=trace)

    def act():
        population.load(stack_copies(genome_of(actor), 2))
        return population(rows(4))["action"]

    with torch.no_grad():
        greedy = actor(rows(4))["action"]
    assert torch.allclose(act(), greedy)
    actor.train()
    assert not torch.allclose(act(), greedy)
    assert not torch.allclose(act(), act()), "as many masks as calls"
    network[1].p = 0.0
    assert torch.allclose(act(), greedy), "an attribute"
    network[1].p = 0.5
    actor.eval()
    assert torch.allclose(act(), greedy)


def test_statistics_that_a_forward_pass_updates_stay_the_actors_own():
    network = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 2)).train()
    actor = TensorDictModule(network, ["observation"], ["action"])
    check = as_it_was(actor)
    population = PopulationActor(actor)
    for members in (1, 3):
        population.load(stack_copies(genome_of(actor), members))
        for _ in range(3):
            population(rows(5 * members))
    check()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda leaf: leaf.double(), r"module\.0\.weight is torch.float32.*torch.float64"),
        (lambda leaf: leaf[:, :1], r"module\.0\.weight has shape \(2, 3\).*\(1, 3\)"),
        (lambda leaf: leaf[..., None], r"module\.0\.weight has shape .*\(2, 3, 1\)"),
    ],
)
def test_genomes_that_do_not_fit_are_refused_by_the_leafs_name(change, message):
    actor = TensorDictModule(nn.Sequential(nn.Linear(3, 2)), ["observation"], ["action"])
    check = as_it_was(actor)
    population = PopulationActor(actor)
    genomes = stack_copies(genome_of(actor), 2)
    genomes["module", "0", "weight"] = change(genomes["module", "0", "weight"])
    with pytest.raises(ValueError, match=message):
        population.load(genomes)
    check()


def test_a_policy_that_cannot_be_copied_is_refused_with_the_reason():
    class Holding(nn.Module):
        def __init__(self):
            super().__init__()
            self.layer, self.lock = nn.Linear(3, 2), threading.Lock()

        def forward(self, observation):
            return self.layer(observation)

    with pytest.raises(ValueError, match=r"cannot be copied.*lock"):
        PopulationActor(TensorDictModule(Holding(), ["observation"], ["action"]))


def test_minus_infinity_forbids_and_everything_else_strange_is_marked():
    class Logits(nn.Module):
        def __init__(self):
            super().__init__()
            self.gain = nn.Parameter(torch.ones(1))

        def forward(self, observation):
            return self.gain * observation

    actor = QValueActor(Logits(), in_keys=["observation"], spec=Categorical(3))
    population = PopulationActor(actor)
    population.load(stack_copies(genome_of(actor), 1))
    nan, inf = math.nan, math.inf
    shown = [[-inf, 1.0, 2.0], [0.0, -inf, -inf], [nan, 0.0, 1.0], [inf, 0.0, 0.0]]
    shown += [[-inf, -inf, -inf], [3.0, 2.0, 1.0]]
    acted = population(TensorDict(observation=torch.tensor(shown), batch_size=[6]))
    assert acted["policy_is_finite"].tolist() == [True, True, False, False, False, True]
    assert acted["action"][[0, 1, 5]].tolist() == [2, 0, 0]
