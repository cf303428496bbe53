"""The fast collector gives the batches that TorchRL's gives."""

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Categorical
from torchrl.envs.utils import ExplorationType
from torchrl.modules import EGreedyModule

from gdrl_tasks import make_task
from gdrl_torchrl.agents.collectors.navigation import NavigationCollector, make_collector
from gdrl_torchrl.agents.networks import make_tanh_normal_actor
from gdrl_torchrl.agents.rainbow.network import make_q_actor
from gdrl_torchrl.envs.make import make_env

WORLDS, STEPS = 3, 12


class Drifting(nn.Module):
    """A policy with a state in Python, which cannot be traced."""

    def __init__(self, size):
        super().__init__()
        self.size = size
        self.calls = 0

    def forward(self, observation):
        self.calls += 1
        return torch.full((len(observation), self.size), (self.calls % 7 - 3) / 3)


class Steering(nn.Module):
    """A policy in NumPy, which tracing must not take for a constant."""

    def forward(self, observation):
        return torch.from_numpy(np.tanh(observation.numpy()[:, :2]))


def task_of(name):
    # So short that episodes end in every batch.
    return make_task(name, step_limit=5)


def greedy(task, noisy=False):
    spec = task.spec
    return make_q_actor(
        spec.observation_size, spec.action_size, value_range=(-1.0, 1.0), noisy=noisy
    )


def epsilon_greedy(task):
    exploration = EGreedyModule(
        Categorical(task.spec.action_size), eps_init=0.5, eps_end=0.1
    )
    return TensorDictSequential(greedy(task), exploration)


def normal(task):
    spec = make_env(task, 1).full_action_spec_unbatched["action"]
    return make_tanh_normal_actor(task.spec.observation_size, spec)


def drifting(task):
    network = Drifting(task.spec.action_size)
    return TensorDictModule(network, ["observation"], ["action"])


def steering(task):
    return TensorDictModule(Steering(), ["observation"], ["action"])


CASES = {
    "greedy": ("indoor", greedy, []),
    "noisy": ("indoor", lambda task: greedy(task, noisy=True), []),
    "epsilon_greedy": ("indoor", epsilon_greedy, ["action_value"]),
    "normal": ("water", normal, ["action_log_prob", "loc"]),
    "in NumPy": ("water", steering, []),
    "in Python": ("water", drifting, []),
}


def batches(kind, name, make_policy, policy_keys, count, **options):
    task = task_of(name)
    env = make_env(task, WORLDS, seed=3, num_threads=1)
    torch.manual_seed(0)
    policy = make_policy(task)
    if kind is NavigationCollector:
        options |= {"policy_keys": policy_keys, "trace": make_policy is not drifting}
    collector = kind(
        env,
        policy,
        frames_per_batch=WORLDS * STEPS,
        total_frames=-1,
        auto_register_policy_transforms=False,
        **options,
    )
    torch.manual_seed(1)
    found = []
    for batch in collector:
        found.append(batch)
        if len(found) == count:
            break
        with torch.no_grad():
            for parameter in policy.parameters():
                parameter.mul_(0.9)
        for module in policy.modules():
            if isinstance(module, EGreedyModule):
                module.eps.mul_(0.5)
    collector.shutdown()
    return found


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("exploration", [ExplorationType.RANDOM, ExplorationType.MEAN])
def test_batches_are_those_of_torchrl(case, exploration):
    if case == "normal" and exploration == ExplorationType.MEAN:
        exploration = ExplorationType.DETERMINISTIC
    options = {"exploration_type": exploration}
    expected = batches(Collector, *CASES[case], 3, **options)
    own = batches(NavigationCollector, *CASES[case], 3, **options)
    for one, other in zip(own, expected, strict=True):
        assert one.batch_size == other.batch_size
        wanted = set(other.keys(True, True)) - {("collector", "traj_ids")}
        outputs = {"action", *CASES[case][2]}
        policy_alone = {"action_value", "chosen_action_value", "loc", "scale"}
        policy_alone |= {"action_log_prob"}
        assert set(one.keys(True, True)) == wanted - (policy_alone - outputs)
        for key in one.keys(True, True):
            assert one[key].dtype == other[key].dtype, key
            assert one[key].shape == other[key].shape, key
            assert torch.equal(one[key], other[key]), key
    assert any(batch["next", "done"].any() for batch in own)


def test_batches_share_no_memory():
    first, second = batches(NavigationCollector, *CASES["normal"], 2)
    kept = first.clone()
    for key in second.keys(True, True):
        second[key].zero_()
    assert (first == kept).all()


def test_a_reset_begins_new_episodes():
    task = task_of("water")
    env = make_env(task, WORLDS, num_threads=1)
    collector = make_collector(
        env, normal(task), frames_per_batch=WORLDS * 2, policy_keys=[]
    )
    assert isinstance(collector, NavigationCollector)
    batch = next(iter(collector))
    collector.reset()
    after = next(iter(collector))
    begun = after["episode_number"].amin()
    assert begun > batch["episode_number"].amax()
    assert (after["episode_steps"][:, 0] == 0).all()
    collector.shutdown()


def test_worlds_of_dm_control_are_stepped_by_torchrl_and_have_no_state():
    env = make_env(task_of("water"), 2, backend="dm_control")
    collector = make_collector(
        env, normal(task_of("water")), frames_per_batch=4, policy_keys=[]
    )
    batches = iter(collector)
    assert next(batches).batch_size == (2, 2)
    assert collector.state_dict() == {"env": {}}
    collector.load_state_dict(collector.state_dict())
    assert (next(batches)["time_left"][:, 0] == 1.0).all(), "episodes begin anew"
    collector.shutdown()


def test_options_that_it_does_not_have_are_refused():
    task = task_of("water")
    with pytest.raises(ValueError, match="init_random_frames"):
        NavigationCollector(
            make_env(task, 2),
            normal(task),
            policy_keys=[],
            frames_per_batch=4,
            total_frames=-1,
            init_random_frames=100,
        )


def test_every_batch_passes_through_the_postproc():
    task = task_of("water")
    collector = NavigationCollector(
        make_env(task, 2),
        normal(task),
        policy_keys=[],
        frames_per_batch=4,
        total_frames=8,
        postproc=lambda batch: batch.select("action"),
    )
    assert [set(batch.keys()) for batch in collector] == [{"action"}] * 2
