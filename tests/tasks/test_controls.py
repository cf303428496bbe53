"""The controls that pin how hard the water task is, over 500 held episodes each."""

import numpy as np
import pytest

import gdrl_tasks
from gdrl_tasks import Outcome, Stream, episode_seeds
from gdrl_tasks.controllers import pursuit

NUM_EPISODES = 500
EPISODES_PER_NETWORK = 10

pytestmark = pytest.mark.slow


def success_rate(policy, **options):
    """Share of episodes that reach the goal; ``policy(observation, episodes)``."""
    worlds = gdrl_tasks.simulate("water", num_worlds=NUM_EPISODES, **options)
    observation = worlds.reset(seeds=episode_seeds(Stream.CONTROLLER, 0, 0, NUM_EPISODES))
    running = np.arange(NUM_EPISODES)
    while len(running):
        result = worlds.step(policy(observation, running), running)
        keep = result.outcome == Outcome.RUNNING
        running, observation = running[keep], result.observation[keep]
    worlds.close()
    assert not (worlds.arrays["outcome"] == Outcome.DIVERGED).any()
    return np.mean(worlds.arrays["outcome"] == Outcome.SUCCESS)


def no_action(observation, episodes):
    return np.zeros((len(observation), 2))


def chase(observation, episodes):
    return pursuit(observation)


def untrained_networks(seed):
    """Policies as PPO starts from: tanh 32-32, tanh-normal actions of unit scale.

    Weights are uniform within 1/sqrt(inputs), as ``torch.nn.Linear`` draws them.
    """
    generator = np.random.default_rng(seed)
    count = NUM_EPISODES // EPISODES_PER_NETWORK
    layers = []
    for inputs, outputs in ((3, 32), (32, 32), (32, 2)):
        bound = 1.0 / np.sqrt(inputs)
        weight = generator.uniform(-bound, bound, (count, outputs, inputs))
        layers.append((weight, generator.uniform(-bound, bound, (count, outputs))))

    def policy(observation, episodes):
        network = episodes // EPISODES_PER_NETWORK
        value = observation
        for weight, bias in layers[:-1]:
            value = np.tanh(np.einsum("koi,ki->ko", weight[network], value) + bias[network])
        weight, bias = layers[-1]
        mean = np.einsum("koi,ki->ko", weight[network], value) + bias[network]
        return np.tanh(mean + generator.normal(size=mean.shape))

    return policy


def test_no_action_almost_never_reaches_the_goal():
    assert success_rate(no_action) <= 0.02


def test_untrained_networks_reach_it_now_and_then():
    assert 0.02 <= success_rate(untrained_networks(0)) <= 0.2


def test_a_pursuit_controller_nearly_always_reaches_it():
    assert success_rate(chase) >= 0.98


def test_the_far_goals_are_harder():
    assert success_rate(untrained_networks(0), difficulty="far") <= 0.02
    assert 0.85 <= success_rate(chase, difficulty="far") < 0.98
