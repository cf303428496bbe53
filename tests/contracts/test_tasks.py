"""What dm_control's suite asks of its tasks, asked of every task registered here."""

import itertools

import numpy as np
import pytest
from dm_env import StepType, specs

import gdrl_tasks

VARIANTS = {
    "water": [
        {},
        {"sea": "calm"},
        {"difficulty": "far"},
        {"actions": "discrete"},
        {"reward": "dense"},
        {"progress_weight": 10.0},
        {"at_limit": "truncated"},
        {"dead_zone_compensated": True, "current_m_s": 0.3},
        {"extra_observations": ("velocity", "roll", "time_left")},
    ],
    "indoor": [
        {},
        {"arena": "scatter"},
        {"arena": "corridor"},
        {"arena": "trap"},
        {"progress_weight": 0.0},
        {"actions": "continuous"},
        {"scan_hold": True},
        {"range_noise": True},
        {"wheel_speed_limit": "burger"},
        {"at_limit": "truncated"},
        {"num_beams": 24, "field_of_view_deg": 360.0},
        {"goal_tolerance_m": 0.05},
        {"speed_m_s": 0.2, "turn_rates_deg_s": (-60.0, 0.0, 60.0)},
    ],
}
CASES = [
    pytest.param((name, options), id="-".join([name, *map(str, options)]))
    for name in gdrl_tasks.task_names()
    for options in VARIANTS.get(name, [{}])
]


def random_policy(action_spec, seed):
    generator = np.random.default_rng(seed)
    if isinstance(action_spec, specs.DiscreteArray):
        return lambda: generator.integers(action_spec.num_values)
    # As dm_control's own suite draws them: the bounds alone say how many there are.
    return lambda: generator.uniform(action_spec.minimum, action_spec.maximum)


def trajectory(environment, *, seed, num_episodes, longest):
    policy = random_policy(environment.action_spec(), seed)
    for _ in range(num_episodes):
        time_step = environment.reset()
        yield time_step
        for _ in range(longest):
            if time_step.last():
                break
            time_step = environment.step(policy())
            yield time_step


@pytest.fixture(scope="module", params=CASES)
def case(request):
    """The name of a task and options of it."""
    return request.param


@pytest.fixture(scope="module")
def played(case):
    """An environment and what its first two episodes gave; it may be played on."""
    name, options = case
    environment = gdrl_tasks.load(name, random=0, **options)
    return environment, list(trajectory(environment, seed=0, num_episodes=2, longest=60))


@pytest.fixture
def environment(played):
    return played[0]


def test_both_tasks_are_registered():
    assert set(gdrl_tasks.task_names()) >= {"indoor", "water"}
    assert set(gdrl_tasks.task_names("discrete")) >= {"indoor", "water"}
    assert gdrl_tasks.task_names("no such tag") == ()


def test_every_element_of_the_model_has_a_name(environment):
    model = environment.physics.model
    counts = {
        "body": model.nbody,
        "joint": model.njnt,
        "geom": model.ngeom,
        "site": model.nsite,
        "camera": model.ncam,
        "light": model.nlight,
        "mesh": model.nmesh,
        "hfield": model.nhfield,
        "texture": model.ntex,
        "material": model.nmat,
        "equality": model.neq,
        "tendon": model.ntendon,
        "actuator": model.nu,
        "sensor": model.nsensor,
    }
    unnamed = [
        f"{kind} {number}"
        for kind, count in counts.items()
        for number in range(count)
        if not model.id2name(number, kind)
    ]
    assert unnamed == []
    assert model.id2name(0, "body") == "world"


def test_a_model_has_a_top_and_a_chase_camera(environment):
    model = environment.physics.model
    cameras = {model.id2name(number, "camera") for number in range(model.ncam)}
    assert cameras >= {"top", "chase"}


def test_time_steps_conform_to_the_specs(played):
    environment, steps = played
    observation_spec = environment.observation_spec()
    low, high = environment.task.task.spec.reward_range
    for time_step in steps:
        assert time_step.observation.keys() == observation_spec.keys()
        for key, spec in observation_spec.items():
            spec.validate(time_step.observation[key])
            assert np.isfinite(time_step.observation[key]).all()
        if time_step.first():
            assert time_step.reward is None
            assert time_step.discount is None
        else:
            assert isinstance(time_step.reward, float)
            assert low <= time_step.reward <= high
            environment.reward_spec().validate(np.asarray(time_step.reward))
            environment.discount_spec().validate(np.asarray(time_step.discount))


def assert_bounds_of_every_element(environment):
    for spec in (environment.action_spec(), *environment.observation_spec().values()):
        assert np.shape(spec.minimum) == spec.shape
        assert np.shape(spec.maximum) == spec.shape


def test_observations_can_be_flat(case, environment):
    name, options = case
    kwargs = {"flat_observation": True}
    flat = gdrl_tasks.load(name, random=0, environment_kwargs=kwargs, **options)
    for one in (environment, flat):
        assert_bounds_of_every_element(one)
        one.task.next_episode_seed = 3
    (key,) = flat.observation_spec()
    observation = flat.reset().observation
    flat.observation_spec()[key].validate(observation[key])
    expected = np.concatenate(list(environment.reset().observation.values()))
    np.testing.assert_array_equal(observation[key], expected)


def test_continuous_actions_are_commands_between_minus_one_and_one(environment):
    spec = environment.action_spec()
    if isinstance(spec, specs.DiscreteArray):
        assert spec.num_values > 1
    else:
        assert (spec.minimum == -1.0).all()
        assert (spec.maximum == 1.0).all()


def test_equal_seeds_and_actions_give_equal_trajectories(case, played):
    name, options = case
    environment = gdrl_tasks.load(name, random=0, **options)
    again = trajectory(environment, seed=0, num_episodes=2, longest=60)
    for one, other in zip(played[1], again, strict=True):
        assert one.step_type == other.step_type
        assert one.reward == other.reward
        assert one.discount == other.discount
        for key, value in one.observation.items():
            np.testing.assert_array_equal(value, other.observation[key])


@pytest.mark.parametrize("name", gdrl_tasks.task_names())
def test_seeds_change_the_episodes(name):
    def first_observation(seed):
        observation = gdrl_tasks.load(name, random=seed).reset().observation
        return np.concatenate(list(observation.values()))

    assert (first_observation(0) != first_observation(1)).any()


def test_the_initial_state_is_randomised(environment):
    starts = []
    for _ in range(2):
        observation = environment.reset().observation
        state = environment.physics.get_state()
        starts.append((np.concatenate(list(observation.values())), state))
    assert (starts[0][0] != starts[1][0]).any()
    assert (starts[0][1] != starts[1][1]).any()


def test_observations_share_no_memory(environment):
    policy = random_policy(environment.action_spec(), 0)
    steps = [environment.reset(), *(environment.step(policy()) for _ in range(2))]
    for earlier, later in itertools.pairwise(steps):
        for key, value in earlier.observation.items():
            assert not np.may_share_memory(value, later.observation[key])


def test_no_element_of_an_observation_is_constant(played):
    environment, steps = played
    for key in environment.observation_spec():
        values = np.array([step.observation[key] for step in steps])
        assert (values != values[0]).any(axis=0).all(), f"{key} has a constant element"


@pytest.mark.parametrize("name", ["water", "indoor"])
@pytest.mark.parametrize(
    ("argument", "value", "option"),
    [
        ("n_sub_steps", 1, "control_interval_s"),
        ("n_sub_steps", 16, "substep_s"),
        ("control_timestep", 0.02, "control_interval_s"),
        ("time_limit", 10.0, "step_limit"),
    ],
)
def test_times_that_contradict_the_task_are_refused(name, argument, value, option):
    with pytest.raises(ValueError, match=f"{argument}={value}.*{option}"):
        gdrl_tasks.load(name, environment_kwargs={argument: value})


@pytest.mark.parametrize("name", ["water", "indoor"])
def test_times_that_are_those_of_the_task_are_taken(name):
    spec = gdrl_tasks.make_task(name).spec
    for kwargs in (
        {"n_sub_steps": spec.num_substeps},
        {"control_timestep": spec.control_interval_s, "time_limit": float("inf")},
    ):
        environment = gdrl_tasks.load(name, environment_kwargs=kwargs)
        assert environment.control_timestep() == pytest.approx(spec.control_interval_s)


def test_environments_without_a_seed_play_other_episodes():
    goals = [gdrl_tasks.load("water") for _ in range(2)]
    first, second = (environment.reset().observation for environment in goals)
    assert first["goal_bearing"] != second["goal_bearing"]


def test_time_between_actions_is_the_control_interval(environment):
    environment.reset()
    start = environment.physics.time()
    environment.step(random_policy(environment.action_spec(), 0)())
    interval = environment.task.task.spec.control_interval_s
    assert environment.physics.time() - start == pytest.approx(interval, abs=1e-12)
    assert environment.control_timestep() == pytest.approx(interval, abs=1e-12)


def distance_to_goal(environment):
    goal = environment.task.arrays["goal"][0]
    return float(np.linalg.norm(goal - environment.physics.data.qpos[:2]))


def progress_weight(name, options):
    """Reward per metre towards the goal."""
    if "progress_weight" in options:
        return options["progress_weight"]
    if name == "indoor":
        return 10.0
    return 1.0 if options.get("reward") == "dense" else 0.0


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *((name, {}) for name in gdrl_tasks.task_names()),
        ("water", {"reward": "dense"}),
        ("water", {"reward": "dense", "progress_weight": 2.5}),
        ("indoor", {"progress_weight": 0.0}),
    ],
)
@pytest.mark.parametrize("at_limit", ["terminated", "truncated"])
def test_an_episode_ends_at_its_step_limit(name, options, at_limit):
    options = options | {"at_limit": at_limit, "step_limit": 5}
    environment = gdrl_tasks.load(name, random=0, **options)
    policy = random_policy(environment.action_spec(), 0)
    environment.reset()
    for step in range(5):
        before = distance_to_goal(environment)
        time_step = environment.step(policy())
        progress = before - distance_to_goal(environment)
        reward = progress_weight(name, options) * progress
        discount = 1.0
        if step == 4 and at_limit == "terminated":
            reward, discount = -1.0, 0.0
        assert time_step.last() == (step == 4)
        assert time_step.discount == discount
        assert time_step.reward == pytest.approx(reward, abs=1e-12)
    assert environment.task.outcome == gdrl_tasks.Outcome.TIMEOUT
    assert environment.step(policy()).step_type == StepType.FIRST


STRAIGHT_TO_A_GOAL = {
    "water": (1.0, np.ones(2), {"sea": "calm", "goal_distance_m": (1.0, 1.0)}),
    "water-dense": (
        1.0,
        np.ones(2),
        {"sea": "calm", "goal_distance_m": (1.0, 1.0), "reward": "dense"},
    ),
    "indoor": (0.33, 2, {}),
    "indoor-continuous": (0.33, np.array([1.0, 0.0]), {"actions": "continuous"}),
}
"""Distance of a goal, the action that drives straight ahead, and options."""
every_way = pytest.mark.parametrize("way", list(STRAIGHT_TO_A_GOAL))


def steps_to_a_goal_ahead(way, step_limit, **options):
    """Full ahead to a goal just in front of the vehicle.

    Returns the environment, all time steps and the distances before and after each.
    """
    distance, action, own = STRAIGHT_TO_A_GOAL[way]
    name, _, _ = way.partition("-")
    environment = gdrl_tasks.load(name, random=0, step_limit=step_limit, **(own | options))
    environment.reset()
    suite_task, physics = environment.task, environment.physics
    position, heading = suite_task.task.planar_pose(physics.data.qpos[None])
    ahead = np.array([np.cos(heading[0]), np.sin(heading[0])])
    suite_task.arrays["goal"][0] = position[0] + distance * ahead
    suite_task.arrays["distance"][0] = distance
    steps, distances = [], [distance_to_goal(environment)]
    while not steps or not steps[-1].last():
        steps.append(environment.step(action))
        distances.append(distance_to_goal(environment))
    return environment, steps, distances


@every_way
def test_the_goal_ends_an_episode_with_its_reward(way):
    environment, steps, distances = steps_to_a_goal_ahead(way, step_limit=100)
    assert environment.task.outcome == gdrl_tasks.Outcome.SUCCESS
    assert steps[-1].reward == 1.0
    assert steps[-1].discount == 0.0
    assert len(steps) > 3
    name, _, kind = way.partition("-")
    weight = progress_weight(name, {"reward": kind})
    progress = weight * -np.diff(distances)
    rewards = [step.reward for step in steps]
    np.testing.assert_allclose(rewards[:-1], progress[:-1], rtol=0.0, atol=1e-12)
    # At the end 1 takes the place of the last step's progress.
    total = 1.0 + weight * (distances[0] - distances[-2])
    assert environment.task.arrays["episode_return"][0] == pytest.approx(total)


@every_way
@pytest.mark.parametrize("at_limit", ["terminated", "truncated"])
def test_the_goal_wins_over_a_timeout_in_the_same_step(way, at_limit):
    _, steps, _ = steps_to_a_goal_ahead(way, step_limit=100)
    environment, last, _ = steps_to_a_goal_ahead(
        way, step_limit=len(steps), at_limit=at_limit
    )
    assert environment.task.outcome == gdrl_tasks.Outcome.SUCCESS
    assert (last[-1].reward, last[-1].discount) == (1.0, 0.0)
    environment, early, _ = steps_to_a_goal_ahead(way, step_limit=len(steps) - 1)
    assert environment.task.outcome == gdrl_tasks.Outcome.TIMEOUT
    assert early[-1].reward == -1.0


def test_running_rewards_are_the_progress_towards_the_goal(case, environment):
    policy = random_policy(environment.action_spec(), 2)
    weight, rewards = progress_weight(*case), []
    for _ in range(2):
        environment.reset()
        for _ in range(10):
            before = distance_to_goal(environment)
            time_step = environment.step(policy())
            if time_step.last():
                break
            progress = before - distance_to_goal(environment)
            assert time_step.reward == pytest.approx(weight * progress, abs=1e-12)
            rewards.append(time_step.reward)
    assert len(rewards) >= 10
    assert np.any(rewards) == (weight > 0.0)


def test_the_mark_of_the_goal_stands_at_the_goal(environment):
    for _ in range(2):
        environment.reset()
        mark = environment.physics.named.data.xpos["goal"]
        np.testing.assert_allclose(mark[:2], environment.task.arrays["goal"][0])
