"""What ``PopulationEvaluator`` promises, against oracles that share no code with it."""

from __future__ import annotations

import math
import threading
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.testing.mocking_classes import (
    ContinuousActionVecMockEnv,
    CountingBatchedEnv,
    DiscreteActionVecMockEnv,
)

import gdrl_tasks
from gdrl_tasks import Outcome, Stream
from gdrl_tasks.seeds import stream_of
from gdrl_torchrl.envs.make import make_env
from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.operators.selection import rank_scores, select_best
from gdrl_torchrl.evolution.population import blocks
from gdrl_torchrl.evolution.population.blocks import block_shapes
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


@pytest.fixture
def evaluator_for(easy_task_for):
    """Makes an evaluator of an actor on an easy task; closed at the end."""
    made = []

    def make(actor, worlds, *, task=None, backend="batch", **options):
        task = task or easy_task_for()
        maker = partial(make_env, task, worlds, backend=backend, num_threads=1)
        made.append(PopulationEvaluator(actor, create_env_fn=maker, **options))
        return made[-1]

    yield make
    for evaluator in made:
        evaluator.close()


def play(task, actor, seed, *, max_steps=math.inf):
    """One episode of one member in one world, in plain Python."""
    worlds = gdrl_tasks.BatchSimulation(task, 1, num_threads=1, seed=0)
    observation = worlds.reset(seeds=np.array([seed]))
    total, steps, outcome = 0.0, 0, Outcome.RUNNING
    while outcome == Outcome.RUNNING and steps < max_steps:
        row = TensorDict(observation=torch.tensor(observation[0], dtype=torch.float32))
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            action = actor(row)["action"].numpy()
        result = worlds.step(action[None])
        observation, outcome = result.observation, Outcome(int(result.outcome[0]))
        total += float(result.reward[0])
        steps += 1
    worlds.close()
    return total, steps, outcome


# Equality with the oracle


def test_scores_equal_playing_each_member_alone(
    actor_kind, actor_of, population_of, member_of, easy_task_for, evaluator_for
):
    actor, task = actor_of(actor_kind), easy_task_for(actor_kind)
    population = population_of(actor, 4)
    seeds = torch.tensor([11, 12, 13])
    result = evaluator_for(actor, 12, task=task, num_episodes=3).evaluate(
        population, seeds=seeds
    )
    for number in range(4):
        member = member_of(actor, population, number)
        episodes = [play(task, member, int(seed)) for seed in seeds]
        returns, steps, outcomes = zip(*episodes, strict=True)
        assert result["steps"][number].tolist() == list(steps)
        assert result["outcomes"][number].tolist() == [int(o) for o in outcomes]
        goals = [outcome == Outcome.SUCCESS for outcome in outcomes]
        assert result["successes"][number].tolist() == goals
        assert result["fitness"][number] == sum(goals)
        assert result["success_rate"][number] == pytest.approx(sum(goals) / 3)
        assert result["frames"][number] == sum(steps)
        # One unit of the actions' last place grows over an episode.
        assert result["returns"][number].tolist() == pytest.approx(returns, abs=1e-5)
        assert result["return_mean"][number] == pytest.approx(sum(returns) / 3, abs=1e-5)


def test_sparse_returns_equal_playing_each_member_alone_to_the_last_digit(
    actor_of, population_of, member_of, easy_task_for, evaluator_for
):
    actor, task = actor_of("tanh_normal"), easy_task_for(reward="sparse")
    population = population_of(actor, 5)
    seeds = torch.tensor([21, 22, 23])
    result = evaluator_for(actor, 15, task=task, num_episodes=3).evaluate(
        population, seeds=seeds
    )
    expected = [
        [play(task, member_of(actor, population, number), int(s))[:2] for s in seeds]
        for number in range(5)
    ]
    assert result["returns"].tolist() == [[r for r, _ in row] for row in expected]
    assert result["steps"].tolist() == [[s for _, s in row] for row in expected]
    assert len(set(result["returns"].flatten().tolist())) > 1


def test_the_parents_copy_scores_exactly_as_the_parent(
    actor_of, population_of, easy_task_for, evaluator_for
):
    actor, task = actor_of("tanh_normal"), easy_task_for()
    seeds = torch.tensor([1, 2, 3, 4])
    evaluator = evaluator_for(actor, 24, task=task, num_episodes=4)
    crowd = evaluator.evaluate(population_of(actor, 6), seeds=seeds)[0]
    env = NavigationEnv(task, 4, num_threads=1, seed=0)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        start = env.reset(episode_seed=seeds)
        path = env.rollout(
            task.spec.step_limit,
            actor,
            tensordict=start,
            auto_reset=False,
            break_when_any_done=False,
            break_when_all_done=True,
        )
    final = path["next"][:, -1]
    env.close()
    assert crowd["successes"].tolist() == final["success"][:, 0].tolist()
    assert crowd["steps"].tolist() == final["episode_steps"][:, 0].tolist()
    assert crowd["returns"].tolist() == pytest.approx(
        final["episode_return"][:, 0].tolist(), abs=1e-5
    )


def test_copies_of_one_member_score_the_same_bit_by_bit(
    actor_of, population_of, evaluator_for
):
    actor = actor_of("tanh_normal")
    population = population_of(actor, 1).expand(5).clone()
    result = evaluator_for(actor, 20, num_episodes=4).evaluate(population)
    for name in ("returns", "steps", "successes", "outcomes"):
        assert (result[name] == result[name][:1]).all(), name


@pytest.mark.parametrize("worlds", [1, 2, 3, 4, 7, 8, 12, 15, 40])
def test_any_number_of_worlds_gives_the_same_scores(
    worlds, actor_of, population_of, easy_task_for, evaluator_for
):
    actor, task = actor_of("tanh_normal"), easy_task_for(step_limit=10)
    population = population_of(actor, 5)
    seeds = torch.tensor([5, 6, 7])

    def scores(count):
        evaluator = evaluator_for(actor, count, task=task, num_episodes=3)
        result, transitions = evaluator.evaluate_with_transitions(population, seeds=seeds)
        return result, transitions

    whole, whole_transitions = scores(15)
    parts, transitions = scores(worlds)
    for name in ("fitness", "steps", "successes", "outcomes", "frames"):
        assert (parts[name] == whole[name]).all(), name
    assert torch.allclose(parts["returns"], whole["returns"], atol=1e-5)
    for name in ("member", "episode"):
        assert (transitions[name] == whole_transitions[name]).all()
    assert torch.allclose(
        transitions["observation"], whole_transitions["observation"], atol=1e-5
    )


def test_the_dm_control_backend_gives_the_same_scores(
    actor_of, population_of, easy_task_for, evaluator_for
):
    actor, task = actor_of("tanh_normal"), easy_task_for(step_limit=8)
    population, seeds = population_of(actor, 2), torch.tensor([1, 2])
    batch, suite = (
        evaluator_for(actor, 4, task=task, backend=backend, num_episodes=2).evaluate(
            population, seeds=seeds
        )
        for backend in ("batch", "dm_control")
    )
    for name in ("fitness", "steps", "successes", "outcomes", "frames"):
        assert (batch[name] == suite[name]).all(), name
    assert torch.allclose(batch["returns"], suite["returns"], atol=1e-5)


# Episodes


def test_every_member_gets_the_same_episodes_and_every_evaluation_new_ones(
    actor_of, population_of, evaluator_for
):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(actor, 12, num_episodes=4, extra_keys=("episode_seed",))
    population = population_of(actor, 3)
    first, second = (evaluator.evaluate(population)["episode_seed"] for _ in range(2))
    for seeds in (first, second):
        assert (seeds == seeds[:1]).all()
        assert len(seeds[0].unique()) == 4
        assert (stream_of(seeds.numpy()) == Stream.FITNESS).all()
    assert not set(first[0].tolist()) & set(second[0].tolist())


def test_the_seed_decides_the_episodes(actor_of, population_of, evaluator_for):
    actor = actor_of("tanh_normal")
    population = population_of(actor, 1)

    def drawn(seed):
        evaluator = evaluator_for(
            actor, 2, num_episodes=2, seed=seed, extra_keys=("episode_seed",)
        )
        return evaluator.evaluate(population)["episode_seed"].tolist()

    assert drawn(3) == drawn(3) != drawn(4)


def test_given_seeds_are_used_and_do_not_count_as_drawn(
    actor_of, population_of, evaluator_for
):
    actor = actor_of("tanh_normal")
    options = {"num_episodes": 2, "extra_keys": ("episode_seed",)}
    population = population_of(actor, 2)
    plain, interrupted = (evaluator_for(actor, 4, **options) for _ in range(2))
    given = interrupted.evaluate(population, seeds=torch.tensor([8, 9]))
    assert given["episode_seed"].tolist() == [[8, 9], [8, 9]]
    fresh = [e.evaluate(population)["episode_seed"].tolist() for e in (plain, interrupted)]
    assert fresh[0] == fresh[1]


def test_extra_keys_are_reported_as_they_are_at_the_end_of_an_episode(
    actor_of, population_of, evaluator_for
):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(
        actor,
        8,
        num_episodes=4,
        extra_keys=("episode_steps", "episode_return", "path_length", "shortest_path"),
    )
    result = evaluator.evaluate(population_of(actor, 2))
    assert (result["episode_steps"] == result["steps"]).all()
    assert torch.allclose(result["episode_return"], result["returns"], atol=1e-5)
    assert (result["shortest_path"] > 0).all()
    assert (result["path_length"] > 0).all()


def test_max_steps_cuts_episodes_off(actor_of, population_of, evaluator_for):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(actor, 4, num_episodes=2, max_steps=3)
    result = evaluator.evaluate(population_of(actor, 2))
    assert (result["steps"] <= 3).all()
    assert (result["steps"] == 3).any()
    assert (result["frames"] == result["steps"].sum(dim=1)).all()
    cut = result["steps"] == 3
    assert not result["successes"][cut & (result["outcomes"] == Outcome.RUNNING)].any()


# Bias: episodes whose length and return depend on member and trial


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


# Members whose numbers are not numbers


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


# Transitions


def test_transitions_are_whole_episodes_in_order(actor_of, population_of, evaluator_for):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(actor, 7, num_episodes=3)
    scores, steps = evaluator.evaluate_with_transitions(population_of(actor, 5))
    assert len(steps) == int(scores["frames"].sum())
    order = steps["member"] * 3 + steps["episode"]
    assert (order.diff() >= 0).all()
    for member in range(5):
        for episode in range(3):
            path = steps[(steps["member"] == member) & (steps["episode"] == episode)]
            assert len(path) == scores["steps"][member, episode]
            assert (path["next", "observation"][:-1] == path["observation"][1:]).all()
            age = path["next", "episode_steps"][:, 0]
            assert age.tolist() == list(range(1, len(path) + 1))
            assert not path["next", "done"][:-1].any()
            assert path["next", "done"][-1].all()
            assert path["next", "reward"].sum() == pytest.approx(
                float(scores["returns"][member, episode]), abs=1e-5
            )
    assert "_step" not in steps.keys(True)


def test_transitions_change_no_score(actor_of, population_of, evaluator_for):
    actor = actor_of("tanh_normal")
    population, seeds = population_of(actor, 3), torch.tensor([1, 2])
    evaluator = evaluator_for(actor, 6, num_episodes=2)
    plain = evaluator.evaluate(population, seeds=seeds)
    scores, _ = evaluator.evaluate_with_transitions(population, seeds=seeds)
    assert (plain == scores).all()


# What an evaluation must leave alone


def test_evaluation_leaves_actor_population_and_global_generator_alone(
    actor_kind, actor_of, population_of, easy_task_for, evaluator_for
):
    actor = actor_of(actor_kind)
    actor.train()
    task = easy_task_for(actor_kind, step_limit=3)
    population = population_of(actor, 2)
    evaluator = evaluator_for(actor, 4, task=task, num_episodes=2)
    weights = {name: value.clone() for name, value in actor.state_dict().items()}
    identities = {name: id(value) for name, value in actor.named_parameters()}
    before, generator = population.clone(), torch.get_rng_state()
    evaluator.evaluate(population)
    assert all((actor.state_dict()[n] == value).all() for n, value in weights.items())
    assert {name: id(value) for name, value in actor.named_parameters()} == identities
    assert all(p.requires_grad for p in actor.parameters())
    assert actor.training
    assert (population == before).all()
    assert (torch.get_rng_state() == generator).all()


def test_an_evaluator_has_no_parameters_and_no_state(actor_of, evaluator_for):
    evaluator = evaluator_for(actor_of("tanh_normal"), 2)
    assert not list(evaluator.parameters())
    assert not evaluator.state_dict()
    assert not list(evaluator.children())


def test_random_exploration_varies_between_copies_of_a_member(
    actor_of, population_of, evaluator_for
):
    actor = actor_of("tanh_normal")
    population = population_of(actor, 1).expand(2).clone()
    evaluator = evaluator_for(
        actor, 2, num_episodes=1, exploration_type=ExplorationType.RANDOM
    )
    returns = evaluator.evaluate(population)["returns"]
    assert returns[0] != returns[1]


# Fitness


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


# Environments of others


def test_counting_worlds_with_horizons_of_their_own(actor_of):
    horizons = torch.tensor([1, 5, 2, 9, 3, 0])
    env = CountingBatchedEnv(max_steps=horizons, batch_size=[6])

    class Increment(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(1))

        def forward(self, observation):
            return (self.weight + 0.0 * observation > 0.5).to(torch.int8)

    actor = TensorDictModule(Increment(), in_keys=["observation"], out_keys=["action"])

    def evaluator_with(seeding):
        return PopulationEvaluator(
            actor,
            num_episodes=3,
            create_env_fn=lambda: env,
            max_steps=12,
            fitness="return",
            episode_seeding=seeding,
        )

    params = TensorDict({("module", "weight"): torch.ones(2, 1)}, batch_size=[2])
    evaluator = evaluator_with("auto")
    # A world counts beyond its horizon by one; members meet the same worlds.
    assert evaluator.evaluate(params)["steps"].tolist() == [[2, 6, 3], [2, 6, 3]]
    # All worlds at once, if their differences do not matter.
    spread = evaluator_with("none").evaluate(params)
    assert spread["steps"].tolist() == [[2, 6, 3], [10, 4, 1]]
    idle = TensorDict({("module", "weight"): torch.zeros(2, 1)}, batch_size=[2])
    assert (evaluator.evaluate(idle)["steps"] == 12).all()


@pytest.mark.parametrize("worlds", [None, 6])
def test_mock_worlds_with_continuous_actions(worlds, actor_of, population_of):
    env = ContinuousActionVecMockEnv()
    if worlds is not None:
        env = SerialEnv(worlds, ContinuousActionVecMockEnv)
    spec = Bounded(-1.0, 1.0, shape=(7,))
    actor = actor_of("tanh_normal", 7, spec)
    evaluator = PopulationEvaluator(
        actor, num_episodes=2, create_env_fn=lambda: env, max_steps=5, fitness="return"
    )
    result = evaluator.evaluate(population_of(actor, 3))
    assert result.batch_size == torch.Size([3])
    assert result["steps"].shape == (3, 2)
    assert not result["successes"].any(), "an environment without success has none"
    assert "outcomes" not in set(result.keys())


@pytest.mark.parametrize("kind", ["q_value", "distributional"])
def test_mock_worlds_with_discrete_actions(kind, actor_of, population_of):
    env = DiscreteActionVecMockEnv()
    actor = actor_of(kind, 7, env.action_spec)
    evaluator = PopulationEvaluator(
        actor, num_episodes=2, create_env_fn=lambda: env, max_steps=5, fitness="return"
    )
    result = evaluator.evaluate(population_of(actor, 3))
    assert (result["steps"] == 5).all()
    assert result["frames"].tolist() == [10, 10, 10]


def test_gymnasium_runs_serially_with_the_same_episodes_for_every_member(
    actor_of, population_of, member_of
):
    env = GymEnv("CartPole-v1", categorical_action_encoding=True)
    actor = actor_of("q_value", 4, env.action_spec)
    population = population_of(actor, 3)
    evaluator = PopulationEvaluator(
        actor, num_episodes=3, create_env_fn=lambda: env, max_steps=60, fitness="return"
    )
    seeds = torch.tensor([3, 4, 5])
    result = evaluator.evaluate(population, seeds=seeds)
    assert (result["returns"] == result["steps"]).all()

    def length(member, seed):
        import gymnasium

        world = gymnasium.make("CartPole-v1").unwrapped
        # A seeded reset, as TorchRL seeds, then that of the episode.
        world.reset(seed=seed)
        observation, _ = world.reset()
        for step in range(1, 61):
            with torch.no_grad():
                row = TensorDict(observation=torch.tensor(observation))
                action = int(member(row)["action"])
            observation, _, ended, _, _ = world.step(action)
            if ended:
                return step
        return 60

    for number in range(3):
        member = member_of(actor, population, number)
        expected = [length(member, int(seed)) for seed in seeds]
        assert result["steps"][number].tolist() == expected
    same = evaluator.evaluate(population[:1].expand(2).clone())
    assert (same["steps"][0] == same["steps"][1]).all()


def test_a_batch_of_gymnasium_environments_gives_every_member_the_same_episodes(
    actor_of, population_of
):
    def env():
        return SerialEnv(
            6, partial(GymEnv, "CartPole-v1", categorical_action_encoding=True)
        )

    spec = GymEnv("CartPole-v1", categorical_action_encoding=True).action_spec
    actor = actor_of("q_value", 4, spec)
    evaluator = PopulationEvaluator(
        actor, num_episodes=3, create_env_fn=env, max_steps=80, fitness="return"
    )
    try:
        result = evaluator.evaluate(population_of(actor, 1).expand(4).clone())
        assert (result["steps"] == result["steps"][:1]).all()
    finally:
        evaluator.close()


def test_stock_dm_control_runs_serially(actor_of, population_of):
    from torchrl.envs import DMControlEnv

    env = DMControlEnv("pendulum", "swingup")
    actor = TensorDictModule(
        nn.Sequential(nn.Linear(2, 1).double(), nn.Tanh()),
        in_keys=["orientation"],
        out_keys=["action"],
    )
    evaluator = PopulationEvaluator(
        actor,
        num_episodes=3,
        create_env_fn=lambda: env,
        max_steps=5,
        fitness="return",
    )
    population = population_of(actor, 1).expand(2).clone()
    _, steps = evaluator.evaluate_with_transitions(population)
    start = steps["orientation"].reshape(2, 3, 5, 2)[:, :, 0]
    assert (start[0] == start[1]).all()
    assert len(start[0].unique(dim=0)) == 3
    evaluator.close()


# Bad input


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_episodes": 0}, "num_episodes=0"),
        ({"num_episodes": -3}, "num_episodes=-3"),
        ({"max_steps": 0}, "max_steps=0"),
        ({"fitness": "best"}, "fitness='best'"),
        ({"episode_seeding": "never"}, "episode_seeding='never'"),
    ],
)
def test_bad_options_are_named_with_their_value(options, message, actor_of):
    with pytest.raises(ValueError, match=message):
        PopulationEvaluator(actor_of("tanh_normal"), **options)


def test_an_evaluator_without_an_environment_says_so(actor_of, population_of):
    actor = actor_of("tanh_normal")
    evaluator = PopulationEvaluator(actor)
    with pytest.raises(RuntimeError, match="create_env_fn"):
        evaluator.evaluate(population_of(actor, 2))


def test_an_unknown_extra_key_is_named(actor_of, population_of, evaluator_for):
    evaluator = evaluator_for(
        actor_of("tanh_normal"), 2, num_episodes=1, extra_keys=("fuel",)
    )
    with pytest.raises(ValueError, match="fuel"):
        evaluator.evaluate(population_of(evaluator.population.actor, 2))


def test_members_without_episodes_are_refused(actor_of, population_of, evaluator_for):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(actor, 2, num_episodes=1)
    with pytest.raises(ValueError, match="seeds"):
        evaluator.evaluate(population_of(actor, 2), seeds=torch.zeros(0, dtype=torch.int64))


def test_evaluation_takes_numpy_seeds_as_well(actor_of, population_of, evaluator_for):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(
        actor, 2, num_episodes=1, max_steps=2, extra_keys=("episode_seed",)
    )
    result = evaluator.evaluate(population_of(actor, 2), seeds=np.array([7]))
    assert result["steps"].tolist() == [[2], [2]]


def test_a_closed_evaluator_can_be_used_again(actor_of, population_of, evaluator_for):
    actor = actor_of("tanh_normal")
    evaluator = evaluator_for(actor, 2, num_episodes=1, max_steps=2)
    population, seeds = population_of(actor, 2), torch.tensor([1])
    first = evaluator.evaluate(population, seeds=seeds)
    evaluator.close()
    assert (evaluator.evaluate(population, seeds=seeds) == first).all()


# The way straight to the simulation


@pytest.mark.parametrize("worlds", [132, 60])
def test_shrinking_blocks_are_whole_batches_of_the_environment(
    worlds, actor_of, population_of
):
    """Straight on the simulation, worlds act in blocks that get fewer."""
    task = gdrl_tasks.make_task("indoor", step_limit=120, num_beams=5)
    actor = actor_of("distributional", 7, Categorical(5))
    population = population_of(actor, 11)
    seeds = torch.arange(12)

    def evaluate(wrap):
        evaluator = PopulationEvaluator(
            actor,
            num_episodes=12,
            create_env_fn=lambda: wrap(NavigationEnv(task, worlds, num_threads=1, seed=0)),
            extra_keys=("path_length", "episode_return"),
        )
        alone = evaluator.evaluate(population, seeds=seeds)
        logged, transitions = evaluator.evaluate_with_transitions(population, seeds=seeds)
        evaluator.close()
        assert (alone == logged).all()
        return alone, transitions

    straight, transitions = evaluate(lambda env: env)
    # Nobody knows what a transform does, so this one is stepped as an environment.
    whole, expected = evaluate(lambda env: TransformedEnv(env, StepCounter()))
    assert straight["steps"].unique().numel() > 20, "episodes end at different times"
    for key in ("steps", "outcomes", "successes", "frames"):
        assert torch.equal(straight[key], whole[key]), key
    for key in ("returns", "fitness", "path_length", "episode_return"):
        assert torch.allclose(straight[key], whole[key], atol=1e-5), key
    expected = expected.exclude("step_count", ("next", "step_count"))
    assert set(transitions.keys(True, True)) == set(expected.keys(True, True))
    for key in expected.keys(True, True):
        if "episode_number" in key:  # idle worlds begin episodes too in an environment
            continue
        one, other = transitions[key], expected[key]
        assert one.dtype == other.dtype, key
        assert torch.allclose(one.double(), other.double(), atol=1e-5), key


def test_any_number_of_threads_gives_the_same_scores_bit_by_bit(
    actor_of, population_of, monkeypatch
):
    monkeypatch.setattr(blocks, "_PART_PRODUCTS", 4_000)
    task = gdrl_tasks.make_task("indoor", step_limit=40, num_beams=5)
    actor = actor_of("q_value", 7, Categorical(5))
    population = population_of(actor, 11)

    def evaluate(threads):
        env = NavigationEnv(task, 132, num_threads=threads, seed=0)
        evaluator = PopulationEvaluator(actor, num_episodes=12, create_env_fn=lambda: env)
        found = evaluator.evaluate(population, seeds=torch.arange(12))
        evaluator.close()
        return found

    one, before = evaluate(1), threading.active_count()
    for threads in (2, 3):
        assert (evaluate(threads) == one).all()
    assert threading.active_count() == before
    weights = sum(value.numel() for value in genome_of(actor).values(True, True))
    assert block_shapes(11, 12, weights)[0].parts > 3
    monkeypatch.undo()
    assert (evaluate(2) == one).all(), "as if there were one part"


def test_torch_has_the_threads_that_it_had(actor_of, population_of, evaluator_for):
    evaluator = evaluator_for(actor_of("tanh_normal"), 6, num_episodes=3)
    population = population_of(actor_of("tanh_normal"), 2)
    seen, bind = [], evaluator.population.bind

    def noting(*args, **kwargs):
        seen.append(torch.get_num_threads())
        return bind(*args, **kwargs)

    evaluator.population.bind = noting
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        evaluator.evaluate(population)
        assert torch.get_num_threads() == 3
        evaluator.population.bind = None
        with pytest.raises(TypeError):
            evaluator.evaluate(population)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert set(seen) == {1}


def test_a_transformed_environment_is_never_bypassed(
    actor_of, population_of, easy_task_for
):
    env = TransformedEnv(
        NavigationEnv(easy_task_for(), 6, num_threads=1, seed=0), StepCounter(5)
    )
    actor = actor_of("tanh_normal")
    evaluator = PopulationEvaluator(actor, num_episodes=3, create_env_fn=lambda: env)
    steps = evaluator.evaluate(population_of(actor, 2))["steps"]
    assert steps.max() == 5, "the transform's limit, not the task's"
    evaluator.close()
