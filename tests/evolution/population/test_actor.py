"""A population as one batch against each member alone, unbatched."""

from __future__ import annotations

import math
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Categorical
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import QValueActor

from gdrl_torchrl.evolution.operators.genome import genome_of, install, stack_copies
from gdrl_torchrl.evolution.population.actor import PopulationActor

MEMBERS, EPISODES = 4, 5


@pytest.fixture(autouse=True)
def _greedy():
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        yield


def rows(count=MEMBERS * EPISODES, size=3):
    generator = torch.Generator().manual_seed(2)
    observation = torch.randn(count, size, generator=generator)
    return TensorDict(observation=observation, batch_size=[count])


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


# Tracing


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


# What happens in a policy stays in its copy


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
