"""The eleven contracts that TorchRL asks of every transform."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs, step_mdp
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator

SCORES = {"fitness", "success_rate", "return_mean", "frames", "successes", "returns"}
EPISODES = 2
MAX_STEPS = 4


@pytest.fixture
def mock_actor(actor_of):
    return actor_of("tanh_normal", 7, Bounded(-1.0, 1.0, shape=(7,)))


@pytest.fixture
def mock_population(mock_actor, population_of):
    return population_of(mock_actor, 3)


@pytest.fixture
def water(easy_task_for):
    env = NavigationEnv(easy_task_for(step_limit=6), 6, num_threads=1, seed=0)
    yield env
    env.close()


@pytest.fixture
def water_actor(actor_of):
    return actor_of("tanh_normal")


@pytest.fixture
def water_population(water_actor, population_of):
    return population_of(water_actor, 3)


def evaluator_of(actor, **options):
    return PopulationEvaluator(actor, num_episodes=EPISODES, max_steps=MAX_STEPS, **options)


def transformed_mock(actor):
    return TransformedEnv(
        ContinuousActionVecMockEnv(), evaluator_of(actor, fitness="return")
    )


def test_single_trans_env_check(water, water_actor, mock_actor):
    check_env_specs(TransformedEnv(water, evaluator_of(water_actor)))
    check_env_specs(transformed_mock(mock_actor))


def test_serial_trans_env_check(mock_actor):
    env = SerialEnv(2, partial(transformed_mock, mock_actor))
    check_env_specs(env)
    env.close()


def test_parallel_trans_env_check(mock_actor):
    env = ParallelEnv(2, partial(transformed_mock, mock_actor), mp_start_method="fork")
    try:
        check_env_specs(env)
    finally:
        env.close(raise_if_closed=False)


def test_trans_serial_env_check(mock_actor, mock_population):
    env = TransformedEnv(
        SerialEnv(2, ContinuousActionVecMockEnv), evaluator_of(mock_actor, fitness="return")
    )
    check_env_specs(env)
    assert env.transform.evaluate(mock_population)["returns"].shape == (3, EPISODES)
    env.close()


def test_trans_parallel_env_check(mock_actor, mock_population):
    env = TransformedEnv(
        ParallelEnv(2, ContinuousActionVecMockEnv, mp_start_method="fork"),
        evaluator_of(mock_actor, fitness="return"),
    )
    try:
        check_env_specs(env)
        assert env.transform.evaluate(mock_population)["returns"].shape == (3, EPISODES)
    finally:
        env.close(raise_if_closed=False)


def test_transform_no_env(water_actor, water_population):
    evaluator = evaluator_of(water_actor)
    data = TensorDict({"params": water_population}, batch_size=[3])
    with pytest.raises(RuntimeError, match="create_env_fn"):
        evaluator(data)
    # Without parameters there is nothing to evaluate, and nothing changes.
    batch = TensorDict(observation=torch.zeros(4, 3), batch_size=[4])
    assert evaluator(batch.clone()).keys() == batch.keys()


def test_transform_compose(water, water_actor, water_population):
    data = TensorDict({"params": water_population}, batch_size=[3])
    with pytest.raises(RuntimeError, match="create_env_fn"):
        Compose(evaluator_of(water_actor))(data.clone())
    composed = Compose(evaluator_of(water_actor, create_env_fn=lambda: water))
    assert set(composed(data).keys()) >= SCORES
    env = TransformedEnv(
        water, Compose(StepCounter(), evaluator_of(water_actor), RewardSum())
    )
    check_env_specs(env)
    assert env.transform[1].evaluate(water_population)["steps"].max() <= MAX_STEPS


def test_transform_env(water, water_actor, water_population):
    seeds = torch.arange(6)
    actions = 2 * torch.rand(5, 6, 2) - 1

    def path(env):
        state, rows = env.reset(episode_seed=seeds), []
        for action in actions:
            state = env.step(state.set("action", action))
            rows.append(state.clone())
            state = step_mdp(state, exclude_action=True)
        # Episodes are numbered on from path to path.
        return torch.stack(rows).exclude("episode_number", ("next", "episode_number"))

    bare = path(water)
    env = TransformedEnv(water, evaluator_of(water_actor))
    transformed = path(env)
    assert set(bare.keys(True)) == set(transformed.keys(True))
    for key in bare.keys(True, True):
        assert (bare[key] == transformed[key]).all(), f"the step path changed {key}"
    assert env.observation_spec == water.observation_spec
    assert env.input_spec == water.input_spec

    own = evaluator_of(water_actor, create_env_fn=lambda: water)
    ours = env.transform.evaluate(water_population, seeds=seeds[:2])
    assert (ours == own.evaluate(water_population, seeds=seeds[:2])).all()


def test_transform_model(water, water_actor, water_population):
    evaluator = evaluator_of(water_actor, create_env_fn=lambda: water)
    ranks = TensorDictModule(lambda x: x.argsort(), in_keys=["fitness"], out_keys=["rank"])
    model = nn.Sequential(evaluator, ranks)
    out = model(TensorDict({"params": water_population}, batch_size=[3]))
    assert set(out.keys()) >= SCORES | {"params", "rank"}
    assert out["rank"].shape == (3,)


@pytest.mark.parametrize("buffer_class", [ReplayBuffer, TensorDictReplayBuffer])
def test_transform_rb(buffer_class, water, water_actor, water_population):
    def buffer(evaluator):
        return buffer_class(storage=LazyTensorStorage(5), transform=evaluator, batch_size=4)

    archive = TensorDict({"params": water_population}, batch_size=[3])
    with_env = buffer(evaluator_of(water_actor, create_env_fn=lambda: water))
    with_env.extend(archive)
    sample = with_env.sample()
    assert set(sample.keys()) >= SCORES
    assert sample["fitness"].shape == (4,)

    without = buffer(evaluator_of(water_actor))
    without.extend(archive)
    with pytest.raises(RuntimeError, match="create_env_fn"):
        without.sample()

    transitions = buffer(evaluator_of(water_actor))
    transitions.extend(TensorDict(observation=torch.zeros(4, 3), batch_size=[4]))
    assert transitions.sample()["observation"].shape == (4, 3)


def test_transform_inverse(water, water_actor, water_population):
    archive = TensorDict({"params": water_population}, batch_size=[3])
    evaluator = evaluator_of(water_actor, create_env_fn=lambda: water)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(5), batch_size=3)
    buffer.append_transform(evaluator)
    buffer.extend(archive.clone())
    # What is stored is what was given: scores are those of a sample.
    assert not SCORES & set(buffer.storage.get(slice(0, 3)).keys())
    assert set(buffer.sample().keys()) >= SCORES
    assert evaluator.num_evaluations == 1
