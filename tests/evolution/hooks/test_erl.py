"""Evolutionary RL: who lives on, when the agent joins, and what is shared."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from gdrl_torchrl import keys
from gdrl_torchrl.evolution.hooks.erl import ErlHook
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.operators.mutation import bernoulli_mutation

MEMBERS = 5


class SizeEvaluator:
    """A genome is the better the larger the sum of its weights."""

    num_episodes = 3

    def __init__(self):
        self.episodes_drawn = 0
        self.populations = []

    def evaluate(self, population, *, seeds=None):
        self.episodes_drawn += self.num_episodes
        self.populations.append(population.clone())
        leaves = population.values(include_nested=True, leaves_only=True)
        total = torch.stack([leaf.flatten(1).sum(dim=1) for leaf in leaves]).sum(dim=0)
        count = len(total)
        return TensorDict(
            {
                keys.FITNESS: total,
                keys.RETURN_MEAN: total.clone(),
                keys.FRAMES: torch.full((count,), 30),
            },
            batch_size=[count],
        )

    def evaluate_with_transitions(self, population, *, seeds=None):
        scores = self.evaluate(population)
        rows = torch.arange(30 * len(scores))
        return scores, TensorDict(row=rows, batch_size=[len(rows)])


@pytest.fixture
def start(actor_of):
    def make(**options):
        torch.manual_seed(0)
        actor = actor_of("tanh_normal")
        rng = torch.Generator().manual_seed(1)
        first = bernoulli_mutation(
            stack_copies(genome_of(actor), MEMBERS), mut_p=1.0, std=0.3, generator=rng
        )
        return ErlHook(actor, SizeEvaluator(), first, **options)

    return make


def is_in(genome, population):
    return [bool((member == genome).all()) for member in population]


def test_the_best_live_on_and_the_champion_is_the_best_that_was_scored(start):
    hook = start(num_elites=2, sync_period=9)
    best = None
    for _ in range(6):
        evaluation = hook.evaluate()
        scored = hook.evaluator.populations[-1]
        fitness = evaluation.scores[keys.FITNESS]
        order = fitness.argsort(descending=True)
        assert evaluation.winner == int(order[0])
        assert (hook.champion == scored[int(order[0])]).all()
        assert (hook.final_genome() == hook.champion).all()
        assert (hook.population[:2] == scored[order[:2]]).all()
        assert best is None or float(fitness.max()) >= best, "elites cannot be lost"
        best = float(fitness.max())
    assert hook.counts.evaluations == 6
    assert hook.counts.steps == 6 * 30 * MEMBERS


@pytest.mark.parametrize("period", [1, 3])
def test_a_copy_of_the_agent_joins_every_few_generations(period, start):
    hook = start(sync_period=period)
    for number in range(7):
        with torch.no_grad():
            for parameter in hook.actor.parameters():
                parameter.add_(0.01)
        agent = genome_of(hook.actor)
        evaluation = hook.evaluate()
        joined = (number + 1) % period == 0
        assert is_in(agent, hook.population) == [False] * (MEMBERS - 1) + [joined]
        assert (evaluation.agent is not None) == (number > 0 and number % period == 0)


def test_the_agent_is_not_changed_and_counts_as_chosen_when_it_becomes_an_elite(start):
    hook = start(num_elites=1)
    hook.evaluate()
    with torch.no_grad():
        for parameter in hook.actor.parameters():
            parameter.fill_(50.0)
    assert not hook.evaluate().switched, "the copy of before was nothing special"
    before = genome_of(hook.actor)
    evaluation = hook.evaluate()
    assert evaluation.switched
    assert evaluation.winner == evaluation.agent == MEMBERS - 1
    assert hook.counts.switches == 1
    assert (genome_of(hook.actor) == before).all()


def test_all_transitions_are_shared_at_every_generation(start):
    shared = []
    hook = start(share_experience=shared.append)
    hook.evaluate(), hook.evaluate()
    assert [len(part) for part in shared] == [30 * MEMBERS] * 2


def test_a_restored_population_goes_on_identically(start):
    whole = start(sync_period=2)
    for _ in range(5):
        whole.evaluate()
    for cut in range(5):
        first, second = start(sync_period=2), start(sync_period=2)
        for _ in range(cut):
            first.evaluate()
        second.load_state_dict(first.state_dict())
        for _ in range(5 - cut):
            second.evaluate()
        assert (second.population == whole.population).all()
        assert (second.champion == whole.champion).all()
        assert second.evaluator.episodes_drawn == whole.evaluator.episodes_drawn


@pytest.mark.parametrize(
    ("name", "value"), [("num_elites", 0), ("num_elites", MEMBERS - 1), ("sync_period", 0)]
)
def test_numbers_that_cannot_be_are_refused_by_name(name, value, start):
    with pytest.raises(ValueError, match=name):
        start(**{name: value})
