"""What a step and an episode can be worth at most, held against what they are."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import gdrl_tasks
from gdrl_tasks import Outcome
from gdrl_tasks.spec import TaskSpec


def spec_with(limit, step_limit):
    return TaskSpec({}, 1, False, 0.1, 0.1, step_limit, running_reward_limit=limit)


@given(
    limit=st.one_of(st.just(0.0), st.floats(0.0, 3.0)),
    step_limit=st.integers(1, 40),
    gamma=st.one_of(st.sampled_from([0.0, 0.9, 0.99, 1.0]), st.floats(0.0, 1.0)),
    length=st.floats(0.0, 1.0),
    is_extreme=st.booleans(),
    is_truncated=st.booleans(),
    seed=st.integers(0, 2**32),
)
@example(
    limit=2.0,
    step_limit=3,
    gamma=1.0,
    length=1.0,
    is_extreme=True,
    is_truncated=True,
    seed=0,
)
def test_no_episode_is_worth_more_than_the_range_of_returns(
    limit, step_limit, gamma, length, is_extreme, is_truncated, seed
):
    generator = np.random.default_rng(seed)
    steps = step_limit if is_truncated else 1 + round(length * (step_limit - 1))
    rewards = limit * generator.uniform(-1.0, 1.0, steps)
    if is_extreme:
        rewards = np.full(steps, limit * generator.choice([-1.0, 1.0]))
    if not is_truncated:
        rewards[-1] = -1.0 if rewards[0] < 0.0 else 1.0
    worth = sum(reward * gamma**step for step, reward in enumerate(rewards))
    low, high = spec_with(limit, step_limit).return_range(gamma)
    assert low == -high
    assert low - 1e-9 <= worth <= high + 1e-9


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.99])
@pytest.mark.parametrize("limit", [0.0, 0.216, 2.0])
def test_the_range_of_returns_holds_what_follows_a_truncation(limit, gamma):
    # A truncated episode is worth its rewards and what the next would have been worth.
    _, high = spec_with(limit, 10).return_range(gamma)
    rewards = limit * np.sum(gamma ** np.arange(10))
    assert rewards + gamma**10 * high <= high + 1e-9


@pytest.mark.parametrize(("limit", "step_limit"), [(0.0, 50), (0.216, 500), (0.0, 1)])
def test_the_range_of_returns_is_no_wider_than_it_must_be(limit, step_limit):
    gamma = 0.99
    _, high = spec_with(limit, step_limit).return_range(gamma)
    lengths = range(1, step_limit + 1)
    ends = [
        limit * np.sum(gamma ** np.arange(length - 1)) + gamma ** (length - 1)
        for length in lengths
    ]
    assert high == pytest.approx(max([*ends, limit / (1.0 - gamma)]))


@pytest.mark.parametrize("gamma", [-0.1, 1.01, float("nan")])
def test_a_discount_out_of_range_is_named(gamma):
    with pytest.raises(ValueError, match=f"gamma={gamma}"):
        spec_with(0.1, 5).return_range(gamma)


DRIVES = [
    ("indoor", {}),
    ("indoor", {"arena": "scatter", "speed_m_s": 0.20}),
    ("indoor", {"arena": "corridor", "actions": "continuous", "speed_m_s": 0.20}),
    ("indoor", {"actions": "continuous", "at_limit": "truncated", "step_limit": 40}),
    ("water", {"reward": "dense", "sea": "rough"}),
    ("water", {"reward": "dense", "actions": "discrete", "current_m_s": 0.5}),
    ("water", {"progress_weight": 10.0, "difficulty": "far"}),
    ("water", {}),
    ("indoor", {"arena": "trap", "progress_weight": 3.0}),
]
"""Every second one is quick."""


@pytest.mark.parametrize(
    ("name", "options"),
    [pytest.param(*d, marks=[pytest.mark.full] * (d not in DRIVES[::2])) for d in DRIVES],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_no_step_is_worth_more_than_its_limit(name, options):
    count = 32
    worlds = gdrl_tasks.simulate(name, num_worlds=count, num_threads=1, seed=1, **options)
    spec = worlds.task.spec
    observation = worlds.reset()
    generator = np.random.default_rng(0)
    largest, seen = 0.0, set()
    for step in range(240):
        # Something new now and then: they reach their full speed in between.
        if step % 12 == 0:
            if spec.is_discrete:
                action = generator.integers(spec.action_size, size=count)
            else:
                action = generator.choice([-1.0, 0.0, 1.0, 1.0], (count, spec.action_size))
        result = worlds.step(action)
        low, high = spec.reward_range
        assert (low <= result.reward).all()
        assert (result.reward <= high).all()
        runs = result.outcome == Outcome.RUNNING
        if worlds.task.truncates_at_limit:
            runs |= result.outcome == Outcome.TIMEOUT
        rewards = result.reward[runs]
        assert (np.abs(rewards) <= spec.running_reward_limit).all()
        largest = max(largest, np.abs(rewards).max(initial=0.0))
        ended = np.flatnonzero(result.terminated | result.truncated)
        seen.update(result.outcome[ended].tolist())
        assert (np.abs(result.reward[ended[~runs[ended]]]) <= 1.0).all()
        observation = worlds.reset(ended)
    assert np.isfinite(observation).all()
    if name == "indoor":
        # They do drive at a goal now and then, at the speed that is asked for.
        assert largest > 0.75 * spec.running_reward_limit
        assert seen
    assert Outcome.DIVERGED not in seen
