"""The controls that pin how hard the tasks are, over 500 held episodes each."""

import itertools

import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import Outcome, Stream, episode_seeds
from gdrl_tasks.controllers import Pilot, Planner, pursue_goal, pursuit

NUM_EPISODES = 500
EPISODES_PER_NETWORK = 10

pytestmark = pytest.mark.slow


def success_rate(name, policy_of, **options):
    """Share of episodes that reach the goal.

    ``policy_of(worlds)`` gives the policy, ``policy(observation, episodes)``.
    """
    worlds = gdrl_tasks.simulate(name, num_worlds=NUM_EPISODES, seed=0, **options)
    observation = worlds.reset(seeds=episode_seeds(Stream.CONTROLLER, 0, 0, NUM_EPISODES))
    policy = policy_of(worlds)
    running = np.arange(NUM_EPISODES)
    while len(running):
        result = worlds.step(policy(observation, running), running)
        keep = result.outcome == Outcome.RUNNING
        running, observation = running[keep], result.observation[keep]
    worlds.close()
    assert not (worlds.arrays["outcome"] == Outcome.DIVERGED).any()
    return np.mean(worlds.arrays["outcome"] == Outcome.SUCCESS)


def no_action(worlds):
    return lambda observation, episodes: np.zeros((len(observation), 2))


def chase(worlds):
    return lambda observation, episodes: pursuit(observation)


def chase_by_turning(worlds):
    return lambda observation, episodes: pursue_goal(observation)


def plan(worlds):
    planner = Planner(worlds.task, worlds.arrays)
    return lambda observation, episodes: planner(episodes, worlds.qpos[episodes])


def steer(worlds):
    pilot = Pilot(worlds.task, worlds.arrays)
    return lambda observation, episodes: pilot(episodes, worlds.qpos[episodes])


def networks(widths, activation, generator):
    """Untrained networks, ten episodes each: ``outputs(observation, episodes)``.

    Weights are uniform within 1/sqrt(inputs), as ``torch.nn.Linear`` draws them.
    """
    count = NUM_EPISODES // EPISODES_PER_NETWORK
    layers = []
    for inputs, outputs in itertools.pairwise(widths):
        bound = 1.0 / np.sqrt(inputs)
        weight = generator.uniform(-bound, bound, (count, outputs, inputs))
        layers.append((weight, generator.uniform(-bound, bound, (count, outputs))))

    def outputs(observation, episodes):
        network = episodes // EPISODES_PER_NETWORK
        value = observation
        for number, (weight, bias) in enumerate(layers):
            value = activation(value) if number else value
            value = np.einsum("koi,ki->ko", weight[network], value) + bias[network]
        return value

    return outputs


def untrained_actors(worlds):
    """Policies as PPO starts from: tanh 32-32, tanh-normal actions of unit scale."""
    generator = np.random.default_rng(0)
    mean = networks((3, 32, 32, 2), np.tanh, generator)

    def policy(observation, episodes):
        value = mean(observation, episodes)
        return np.tanh(value + generator.normal(size=value.shape))

    return policy


def untrained_q_networks(worlds):
    """Greedy policies of untrained networks: ReLU 64-64, five values."""
    size = worlds.task.spec.observation_size
    values = networks(
        (size, 64, 64, 5), lambda x: np.maximum(x, 0.0), np.random.default_rng(0)
    )
    return lambda observation, episodes: values(observation, episodes).argmax(axis=1)


def anything(worlds):
    """A choice at random at every step: where epsilon starts."""
    generator = np.random.default_rng(0)
    return lambda observation, episodes: generator.integers(5, size=len(episodes))


@pytest.mark.full
def test_no_action_almost_never_crosses_the_water():
    assert success_rate("water", no_action) <= 0.02


@pytest.mark.full
def test_untrained_networks_cross_it_now_and_then():
    assert 0.02 <= success_rate("water", untrained_actors) <= 0.2


def test_a_pursuit_controller_nearly_always_crosses_it():
    assert success_rate("water", chase) >= 0.98


@pytest.mark.full
def test_far_goals_are_harder():
    assert success_rate("water", untrained_actors, difficulty="far") <= 0.02
    assert 0.85 <= success_rate("water", chase, difficulty="far") < 0.98


@pytest.mark.full
def test_who_knows_the_current_reaches_far_goals_in_it():
    options = {"difficulty": "far", "current_m_s": 0.4}
    assert success_rate("water", steer, **options) >= 0.9
    assert success_rate("water", chase, **options) <= 0.85


@pytest.mark.full
@pytest.mark.parametrize("arena", ["paper", "scatter"])
@pytest.mark.parametrize("policy_of", [untrained_q_networks, anything])
def test_who_has_learnt_nothing_fails_indoors(arena, policy_of):
    assert success_rate("indoor", policy_of, arena=arena) <= 0.05


@pytest.mark.full
def test_the_blocks_stop_who_only_pursues_the_goal():
    assert 0.2 <= success_rate("indoor", chase_by_turning) <= 0.6


@pytest.mark.full
@pytest.mark.parametrize("arena", ["trap", "paper", "scatter", "corridor"])
def test_a_planner_shows_that_every_arena_can_be_solved(arena):
    assert success_rate("indoor", plan, arena=arena) >= 0.95


@pytest.mark.full
def test_the_small_goal_and_the_real_wheels_leave_it_solvable():
    options = {"goal_tolerance_m": 0.05, "wheel_speed_limit": "burger"}
    assert success_rate("indoor", plan, **options) >= 0.95
