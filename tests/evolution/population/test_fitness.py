"""Fitness: what counts, no favour to short episodes, and none where numbers are none."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from gdrl_torchrl.evolution.operators.selection import rank_scores, select_best
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


class CountdownEnv(EnvBase):
    """An episode lasts ``seed * action`` steps and pays its own length at each.

    ``honest=False`` ignores the mask of frozen worlds: it goes on and pays.
    """

    def __init__(self, worlds: int, *, honest: bool = True) -> None:
        super().__init__(batch_size=[worlds])
        self.honest = honest
        self.stepped = 0
        column = (worlds, 1)
        self.observation_spec = Composite(
            observation=Unbounded(shape=column),
            episode_seed=Unbounded(shape=column, dtype=torch.int64),
            shape=(worlds,),
        )
        self.action_spec = Bounded(low=0.0, high=1e6, shape=column)
        self.reward_spec = Unbounded(shape=column)

    def _read(self, **others):
        entries = {"observation": self.seeds.float(), "episode_seed": self.seeds.clone()}
        return TensorDict(entries | others, batch_size=self.batch_size)

    def _reset(self, tensordict, episode_seed=None, **kwargs):
        self.seeds = episode_seed.reshape(-1, 1)
        self.age = torch.zeros_like(self.seeds)
        return self._read(done=self.age > 0, terminated=self.age > 0)

    def _step(self, tensordict):
        length = (self.seeds * tensordict["action"]).round()
        mask = tensordict.get("_step", None)
        if mask is None or not self.honest:
            mask = torch.ones(self.batch_size, dtype=torch.bool)
        self.stepped += int(mask.sum())
        self.age += mask[:, None]
        reward = torch.where(mask[:, None], length, torch.zeros_like(length))
        done = self.age >= length
        return self._read(reward=reward, done=done, terminated=done.clone())

    def _set_seed(self, seed):
        pass


def constant_actor():
    """Its action is its only weight, whatever it sees."""

    class Constant(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(1))

        def forward(self, observation):
            return self.weight + 0.0 * observation

    return TensorDictModule(Constant(), in_keys=["observation"], out_keys=["action"])


@pytest.mark.parametrize("honest", [True, False])
@pytest.mark.parametrize("worlds", [1, 4, 12, 30])
def test_short_episodes_are_not_favoured(worlds, honest):
    env = CountdownEnv(worlds, honest=honest)
    evaluator = PopulationEvaluator(
        constant_actor(), num_episodes=4, create_env_fn=lambda: env, fitness="return"
    )
    weights = torch.tensor([[1.0], [2.0], [5.0]])
    params = TensorDict({("module", "weight"): weights}, batch_size=[3])
    trials = [1, 3, 10, 40]
    result = evaluator.evaluate(params, seeds=torch.tensor(trials))
    lengths = [[trial * int(weight) for trial in trials] for weight in weights]
    assert result["steps"].tolist() == lengths
    assert result["returns"].tolist() == [[n * n for n in row] for row in lengths]
    means = [sum(n * n for n in row) / 4 for row in lengths]
    assert result["fitness"].tolist() == pytest.approx(means)
    assert result["frames"].tolist() == [sum(row) for row in lengths]
    if honest and worlds <= 12:
        assert env.stepped == sum(map(sum, lengths)), "frozen worlds must not step"


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("fitness", ["goals", "return"])
def test_a_member_that_is_not_finite_has_no_fitness_and_ranks_last(
    fitness, value, actor_kind, actor_of, population_of, easy_task_for, evaluator_for
):
    actor = actor_of(actor_kind)
    task = easy_task_for(actor_kind, step_limit=5)
    population = population_of(actor, 3)
    seeds = torch.tensor([1, 2])
    evaluator = evaluator_for(actor, 6, task=task, num_episodes=2, fitness=fitness)
    healthy = evaluator.evaluate(population, seeds=seeds)
    broken = population.clone()
    broken[1].apply_(lambda leaf: leaf.fill_(value))
    result = evaluator.evaluate(broken, seeds=seeds)
    assert math.isnan(result["fitness"][1])
    assert rank_scores(result["fitness"]).argmin() == 1
    assert select_best(result, parent=1) != 1
    for name in ("fitness", "returns", "steps", "successes"):
        assert (result[name][[0, 2]] == healthy[name][[0, 2]]).all(), name


def test_a_member_that_breaks_in_its_last_trial_only_has_no_fitness(
    actor_of, population_of, easy_task_for
):
    class Fragile(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(1))

        def forward(self, observation):
            return self.weight / (observation - 3.0).abs().clamp_max(1.0)

    actor = TensorDictModule(Fragile(), in_keys=["observation"], out_keys=["action"])
    evaluator = PopulationEvaluator(
        actor,
        num_episodes=3,
        create_env_fn=lambda: CountdownEnv(2),
        max_steps=4,
        fitness="return",
    )
    params = TensorDict({("module", "weight"): torch.ones(1, 1)}, batch_size=[1])
    assert not math.isnan(
        evaluator.evaluate(params, seeds=torch.tensor([1, 2, 4]))["fitness"]
    )
    assert math.isnan(evaluator.evaluate(params, seeds=torch.tensor([1, 2, 3]))["fitness"])


def test_goals_cannot_be_counted_where_the_environment_names_none(actor_of, population_of):
    actor = actor_of("tanh_normal")
    evaluator = PopulationEvaluator(
        actor, num_episodes=2, create_env_fn=lambda: CountdownEnv(2), max_steps=4
    )
    with pytest.raises(ValueError, match="success"):
        evaluator.evaluate(population_of(actor, 2))


def test_fitness_is_goals_return_or_what_a_function_says(
    actor_of, population_of, evaluator_for
):
    actor = actor_of("tanh_normal")
    population, seeds = population_of(actor, 4), torch.tensor([1, 2, 3])

    def scored(fitness):
        evaluator = evaluator_for(actor, 12, num_episodes=3, fitness=fitness)
        return evaluator.evaluate(population, seeds=seeds)

    goals = scored("goals")
    assert (goals["fitness"] == goals["successes"].sum(dim=1)).all()
    returns = scored("return")
    assert (returns["fitness"] == returns["returns"].mean(dim=1)).all()
    quick = scored(lambda result: -result["steps"].sum(dim=1))
    assert (quick["fitness"] == -quick["frames"]).all()
