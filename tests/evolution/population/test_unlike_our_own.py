"""Policies and environments unlike our own in ``PopulationEvaluator``."""

from __future__ import annotations

import logging
import math
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from gdrl_torchrl.agents.rainbow.n_step import NStep
from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.population import env_rollout as population_rollout
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


class PaysEnv(EnvBase):
    """Pays what its seed says at every step, and ends after three or never."""

    def __init__(self, rewards, *, ends=True):
        super().__init__(batch_size=[])
        self.rewards, self.ends = rewards, ends
        self.observation_spec = Composite(observation=Unbounded((3,)))
        self.action_spec = Bounded(-1.0, 1.0, (2,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict, **kwargs):
        self.age = 0
        return TensorDict(observation=torch.ones(3), done=torch.zeros(1, dtype=torch.bool))

    def _step(self, tensordict):
        self.age += 1
        return TensorDict(
            observation=torch.ones(3),
            reward=torch.tensor([self.rewards[self.seed % len(self.rewards)]]),
            done=torch.tensor([self.ends and self.age == 3]),
        )

    def _set_seed(self, seed):
        self.seed = seed


def evaluator_in(env, actor, **options):
    options = {"fitness": "return", "num_episodes": 2} | options
    return PopulationEvaluator(actor, create_env_fn=lambda: env, **options)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_return_that_is_no_number_is_no_fitness_and_says_so(
    value, actor_of, population_of, caplog
):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_in(PaysEnv([1.0, value]), actor)
    population = population_of(actor, 2)
    with caplog.at_level(logging.WARNING):
        assert torch.isfinite(evaluator.evaluate(population, seeds=[2, 4])["fitness"]).all()
        assert not caplog.records
        scores = evaluator.evaluate(population, seeds=[2, 3])
    assert torch.isnan(scores["fitness"]).all()
    [record] = caplog.records
    said = record.getMessage()
    assert "NaN for all 2 members" in said
    assert "actions are no numbers for 0, returns for 2" in said


def test_a_population_of_broken_policies_is_told_as_such(actor_of, population_of, caplog):
    actor = actor_of("tanh_normal")
    population = population_of(actor, 3).apply(lambda leaf: leaf * math.nan)
    with caplog.at_level(logging.WARNING):
        scores = evaluator_in(PaysEnv([1.0]), actor).evaluate(population)
    assert torch.isnan(scores["fitness"]).all()
    assert "actions are no numbers for 3, returns for 0" in caplog.text


def test_one_broken_member_is_no_cause_for_a_warning(actor_of, population_of, caplog):
    actor = actor_of("tanh_normal")
    population = population_of(actor, 3)
    population[1].apply_(lambda leaf: leaf.fill_(math.nan))
    with caplog.at_level(logging.WARNING):
        scores = evaluator_in(PaysEnv([1.0]), actor).evaluate(population)
    assert torch.isnan(scores["fitness"]).tolist() == [False, True, False]
    assert not caplog.records


def test_an_action_that_is_not_finite_is_marked_whatever_it_is_called():
    class TwoNamed(PaysEnv):
        def __init__(self):
            super().__init__([1.0])
            self.action_spec = Composite(push=Bounded(-1.0, 1.0, (2,)))

    class Push(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(2))

        def forward(self, observation):
            return self.weight.expand(*observation.shape[:-1], 2)

    actor = TensorDictModule(Push(), ["observation"], ["push"])
    population = stack_copies(genome_of(actor), 2)
    population["module", "weight"][1, 0] = -math.inf
    fitness = evaluator_in(TwoNamed(), actor).evaluate(population)["fitness"]
    assert torch.isnan(fitness).tolist() == [False, True]


# Episodes


def environments(task):
    navigation = partial(NavigationEnv, task, 6, num_threads=1, seed=0)
    return {
        "straight": navigation,
        "transformed": lambda: TransformedEnv(navigation(), StepCounter()),
        "serial": lambda: TransformedEnv(
            NavigationEnv(task, 1, num_threads=1, seed=0), StepCounter()
        ),
    }


@pytest.mark.parametrize("kind", ["straight", "transformed", "serial"])
def test_the_last_step_of_an_episode_that_is_cut_off_is_truncated(
    kind, actor_of, population_of, easy_task_for
):
    actor, task = actor_of("tanh_normal"), easy_task_for()
    env = environments(task)[kind]()
    evaluator = evaluator_in(env, actor, num_episodes=3, max_steps=5)
    scores, steps = evaluator.evaluate_with_transitions(population_of(actor, 2))
    assert (scores["steps"] == 5).any(), "some are cut off"
    episode = steps["member"] * 3 + steps["episode"]
    is_last = torch.cat([episode.diff() != 0, torch.ones(1, dtype=torch.bool)])
    done, truncated, terminated = (
        steps["next", name].flatten() for name in ("done", "truncated", "terminated")
    )
    assert (done == is_last).all()
    assert (truncated == (is_last & ~terminated)).all()
    assert not steps["done"].any()
    windows = NStep(0.9, 3)(steps)
    last = torch.arange(len(steps)) + windows["steps_to_next_obs"].flatten() - 1
    assert (episode[last] == episode).all(), "no window goes on in the next episode"
    for row in range(len(steps)):
        reward = steps["next", "reward"][row : int(last[row]) + 1].flatten()
        expected = sum(0.9**k * float(value) for k, value in enumerate(reward))
        assert float(windows["next", "reward"][row]) == pytest.approx(expected, abs=1e-5)
    evaluator.close()


def test_an_environment_without_a_flag_of_truncation_gets_one_where_episodes_are_cut(
    actor_of, population_of
):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_in(PaysEnv([1.0], ends=False), actor, max_steps=2)
    _, steps = evaluator.evaluate_with_transitions(population_of(actor, 1))
    assert steps["next", "truncated"].flatten().tolist() == [False, True, False, True]
    assert steps["next", "done"].flatten().tolist() == [False, True, False, True]


def test_an_episode_that_never_ends_is_an_error_that_says_what_to_set(
    actor_of, population_of, monkeypatch
):
    monkeypatch.setattr(population_rollout, "LONGEST_EPISODE", 20)
    actor = actor_of("tanh_normal")
    evaluator = evaluator_in(PaysEnv([1.0], ends=False), actor)
    with pytest.raises(RuntimeError, match=r"not ended after 20 steps.*max_steps"):
        evaluator.evaluate(population_of(actor, 1))
    patient = evaluator_in(PaysEnv([1.0], ends=False), actor, max_steps=30)
    assert (patient.evaluate(population_of(actor, 1))["steps"] == 30).all()


def test_given_seeds_are_those_of_the_episodes_in_a_batch_with_one_seed(actor_of):
    make = partial(GymEnv, "CartPole-v1", categorical_action_encoding=True)
    actor = actor_of("q_value", 4, make().action_spec)
    genomes = stack_copies(genome_of(actor), 1)
    lone, batch = make(), SerialEnv(4, make)

    def starts(env, seeds):
        evaluator = evaluator_in(env, actor, max_steps=30, num_episodes=len(seeds))
        scores, steps = evaluator.evaluate_with_transitions(genomes, seeds=seeds)
        firsts = [steps[steps["episode"] == k]["observation"][0] for k in range(len(seeds))]
        return scores["steps"], torch.stack(firsts)

    for seeds in ([7, 7, 7], [3, 7, 5, 7, 1]):
        alone, other = starts(lone, seeds), starts(batch, seeds)
        assert torch.equal(alone[0], other[0])
        assert torch.equal(alone[1], other[1])
        for one in range(len(seeds)):
            for two in range(one):
                same = torch.equal(other[1][one], other[1][two])
                assert same == (seeds[one] == seeds[two])
    batch.close()


# Policies in a batch of worlds


class Following(nn.Module):
    """Follows the mean of what it is shown."""

    def __init__(self):
        super().__init__()
        self.register_buffer("mean", torch.zeros(3))

    def forward(self, value):
        if self.training:
            self.mean.lerp_(value.reshape(-1, 3).mean(0), 0.2)
        return value - self.mean


LAYERS = {
    "batch_norm": lambda: nn.BatchNorm1d(3),
    "following": Following,
    "layer_norm": lambda: nn.LayerNorm(3),
    "spectral": lambda: torch.nn.utils.parametrizations.spectral_norm(nn.Linear(3, 3)),
}


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("training", [True, False])
def test_in_a_batch_of_worlds_members_act_as_each_would_alone_in_its_worlds(
    layer, training, easy_task_for
):
    def make_actor():
        torch.manual_seed(0)
        network = nn.Sequential(LAYERS[layer](), nn.Linear(3, 2), nn.Tanh())
        return TensorDictModule(network, ["observation"], ["action"]).train(training)

    task, seeds = easy_task_for(step_limit=12), torch.tensor([5, 6, 7])
    actor = make_actor()
    genomes = stack_copies(genome_of(actor), 2)
    genomes[1].apply_(lambda leaf: leaf.add_(0.5))
    env = NavigationEnv(task, 6, num_threads=1, seed=0)
    evaluator = evaluator_in(env, actor, num_episodes=3)
    scores = evaluator.evaluate(genomes, seeds=seeds)
    assert bool(evaluator.population.reason) == (training and layer != "layer_norm")
    for number in range(2):
        member, alone = make_actor(), NavigationEnv(task, 3, num_threads=1, seed=0)
        for path, value in genomes[number].items(True, True):
            dict(member.named_parameters())[".".join(path)].data.copy_(value)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            final = alone.rollout(
                12,
                member,
                tensordict=alone.reset(episode_seed=seeds),
                auto_reset=False,
                break_when_any_done=False,
                break_when_all_done=True,
            )["next"][:, -1]
        alone.close()
        assert scores["steps"][number].tolist() == final["episode_steps"].flatten().tolist()
        returns = final["episode_return"].flatten().tolist()
        assert scores["returns"][number].tolist() == pytest.approx(returns, abs=1e-5)
    evaluator.close()


def test_without_tracing_the_scores_are_the_same(actor_kind, actor_of, population_of):
    from gdrl_tasks import make_task

    actions = "discrete" if actor_kind in ("q_value", "distributional") else "continuous"
    task = make_task("water", sea="calm", step_limit=8, actions=actions, reward="dense")
    actor = actor_of(actor_kind)
    population, seeds = population_of(actor, 3), torch.tensor([1, 2])

    def scored(**options):
        env = NavigationEnv(task, 6, num_threads=1, seed=0)
        evaluator = evaluator_in(env, actor, **options)
        found = evaluator.evaluate(population, seeds=seeds)
        evaluator.close()
        return found

    traced, plain = scored(), scored(trace=False)
    for key in ("steps", "successes"):
        assert torch.equal(traced[key], plain[key])
    assert torch.allclose(traced["returns"], plain["returns"], atol=1e-5)


def test_a_recurrent_policy_without_a_number_in_it_has_no_fitness(caplog):
    from tests.contracts.policies import CASES

    [case] = [case for case in CASES if case.name == "LSTM"]
    actor, env = case.make()
    population = stack_copies(genome_of(actor), 2)
    population.apply_(lambda leaf: leaf.fill_(math.nan))
    evaluator = evaluator_in(env, actor, max_steps=3)
    assert torch.isnan(evaluator.evaluate(population)["fitness"]).all()
    assert "actions are no numbers for 2" in caplog.text
    population[1] = genome_of(actor)
    fitness = evaluator.evaluate(population)["fitness"]
    assert torch.isnan(fitness).tolist() == [True, False]
