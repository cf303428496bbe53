"""Environments of others are scored, too: mock worlds, Gymnasium, dm_control."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import Compose, GymEnv, RewardSum, SerialEnv, TransformedEnv
from torchrl.testing.mocking_classes import (
    ContinuousActionVecMockEnv,
    CountingBatchedEnv,
    DiscreteActionVecMockEnv,
)

from gdrl_torchrl.envs.success import ReturnSuccess
from gdrl_torchrl.evolution.operators.genome import genome_of, stack_copies
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


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


def test_what_an_episode_has_reached_when_it_is_cut_off_counts(actor_of):
    """A flag of the return stands before the environment ends."""

    def cartpole(threshold):
        flag = Compose(RewardSum(), ReturnSuccess(threshold))
        return TransformedEnv(GymEnv("CartPole-v1"), flag)

    actor = actor_of("q_value", 4, GymEnv("CartPole-v1").action_spec)
    genomes = stack_copies(genome_of(actor), 2)
    for threshold, success in ((5.0, True), (6.5, False)):
        evaluator = PopulationEvaluator(
            actor,
            num_episodes=2,
            create_env_fn=partial(cartpole, threshold),
            max_steps=6,
        )
        scores = evaluator.evaluate(genomes)
        assert (scores["steps"] == 6).all()
        assert (scores["successes"] == success).all()
        evaluator.close()
