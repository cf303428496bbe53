"""Batches that are collected ahead: of which weights, with which draws, and again."""

import itertools
import multiprocessing
import os
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import Categorical
from torchrl.modules import EGreedyModule

from gdrl_tasks import BatchSimulation, make_task
from gdrl_torchrl.agents.collectors import ahead as collect_ahead
from gdrl_torchrl.agents.collectors.ahead import AheadCollector
from gdrl_torchrl.agents.collectors.navigation import make_collector
from gdrl_torchrl.agents.collectors.worker import WorkerDiedError
from gdrl_torchrl.agents.rainbow.network import make_q_actor
from gdrl_torchrl.envs.make import make_env
from gdrl_torchrl.files.metrics import MetricsTable
from gdrl_torchrl.files.state import read_state, write_state
from gdrl_torchrl.runs.run import run_experiment
from tests.marks import full_but

WORLDS, STEPS = 3, 8
TASK = make_task("indoor", step_limit=5)


def make_policy(noisy=False):
    torch.manual_seed(0)
    spec = TASK.spec
    actor = make_q_actor(
        spec.observation_size, spec.action_size, value_range=(-1.0, 1.0), noisy=noisy
    )
    exploration = EGreedyModule(Categorical(spec.action_size), eps_init=0.5, eps_end=0.1)
    modules: list[Any] = [actor, exploration]
    return TensorDictSequential(*modules)


def learn(policy):
    """Change all that a batch is made with, in place."""
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.mul_(-0.9)
    policy[1].eps.mul_(0.7)


def make_worlds():
    return make_env(TASK, WORLDS, seed=3, num_threads=1)


def kill_worker():
    [process] = multiprocessing.active_children()
    process.kill()
    process.join()


@pytest.fixture
def ahead():
    """Makes collectors that are ahead, and ends them."""
    made = []

    def make(policy, in_process=True):
        def worlds():
            frames = WORLDS * STEPS
            return make_collector(
                make_worlds(), policy, frames_per_batch=frames, policy_keys=[]
            )

        made.append(AheadCollector(worlds, policy, seed=5, in_process=in_process))
        return made[-1]

    yield make
    for collector in made:
        collector.shutdown()


def batches_with(collector, policy, count):
    found = []
    for _ in range(count):
        found.append(collector.rollout())
        learn(policy)
    return found


def assert_same(batches, others):
    for one, other in zip(batches, others, strict=True):
        assert one.batch_size == other.batch_size
        for key in one.keys(True, True):
            assert one[key].dtype == other[key].dtype, key
            assert torch.equal(one[key], other[key]), key


@pytest.mark.parametrize("in_process", [True, False])
@pytest.mark.parametrize("noisy", full_but([True], [False, True]))
def test_batches_are_those_of_weights_one_batch_old(ahead, in_process, noisy):
    policy = make_policy(noisy)
    collector = ahead(policy, in_process)
    before = torch.get_rng_state()
    own = batches_with(collector, policy, 6)
    assert torch.equal(torch.get_rng_state(), before), "draws are of a generator apart"

    # TorchRL's collector, told by hand what to act with.
    policy, learner = make_policy(noisy), make_policy(noisy)
    torch.manual_seed(5)
    plain = Collector(
        make_worlds(),
        policy,
        frames_per_batch=WORLDS * STEPS,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    expected = []
    for batch in itertools.islice(plain, 6):
        expected.append(batch)
        policy.load_state_dict(learner.state_dict())
        learn(learner)
    plain.shutdown()
    assert_same(own, [batch.select(*own[0].keys(True, True)) for batch in expected])
    assert len({tuple(batch["action"].flatten().tolist()) for batch in own}) == 6


@pytest.mark.parametrize("in_process", [True, False])
def test_a_state_goes_on_as_if_nothing_had_been(ahead, in_process, tmp_path):
    policy = make_policy()
    whole = ahead(policy, in_process)
    expected = batches_with(whole, policy, 6)
    for count in (0, 1, 3):
        policy = make_policy()
        first = ahead(policy, in_process)
        found = batches_with(first, policy, count)
        write_state(tmp_path / "state", first.state_dict())
        # Looking changes nothing.
        assert_same(found + batches_with(first, policy, 6 - count), expected)
        policy = make_policy()
        for _ in range(count):
            learn(policy)
        second = ahead(policy, in_process)
        batches_with(second, make_policy(), 2)
        second.load_state_dict(read_state(tmp_path / "state"))
        rest = batches_with(second, policy, 6 - count)
        assert_same(rest, expected[count:])


def test_a_state_that_does_not_fit_is_refused(ahead):
    collector = ahead(make_policy())
    state = collector.state_dict()
    worlds = state["worlds"]["collector"]["env"]
    worlds["qpos"] = worlds["qpos"][:1]
    with pytest.raises(ValueError, match="qpos has shape"):
        collector.load_state_dict(state)


@pytest.mark.parametrize("in_process", [True, False])
def test_worlds_that_diverge_are_told_with_their_batch(ahead, in_process, monkeypatch):
    step, steps = BatchSimulation.step, 0

    def injured(simulation, action, ids=None):
        nonlocal steps
        steps += 1
        if steps == STEPS + 2:
            simulation.qvel[1] = float("nan")
        return step(simulation, action, ids)

    monkeypatch.setattr(BatchSimulation, "step", injured)
    policy = make_policy()
    collector = ahead(policy, in_process)
    told = []
    collector.watch(told.append)
    collector.rollout()
    assert not told
    collector.state_dict()
    assert [world.world for world in told] == [1]
    batches_with(collector, policy, 2)
    assert len(told) == 1


def test_a_killed_process_is_an_error_and_no_hang(ahead):
    collector = ahead(make_policy())
    collector.rollout()
    kill_worker()
    for call in (collector.state_dict, collector.rollout):
        with pytest.raises(WorkerDiedError, match="killed by SIGKILL"):
            call()


def test_a_daemon_collects_by_itself(ahead):
    expected = batches_with(ahead(make_policy()), make_policy(), 2)

    def collect(connection):
        # Other threads of torch are not there after a fork.
        torch.set_num_threads(1)
        collector = ahead(make_policy())
        batches = batches_with(collector, make_policy(), 2)
        connection.send([batch["action"].numpy() for batch in batches])

    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    process = context.Process(target=collect, args=(theirs,), daemon=True)
    process.start()
    theirs.close()
    for batch, actions in zip(expected, ours.recv(), strict=True):
        assert (batch["action"].numpy() == actions).all()
    process.join()


@pytest.mark.full
def test_a_run_is_the_same_without_a_process(
    tiny_rainbow, rows_of, evaluation_of, monkeypatch
):
    def outcome(name):
        path = run_experiment(tiny_rainbow("algorithm.collect_ahead=true", f"name={name}"))
        return rows_of(path), evaluation_of(path)["params_sha256"]

    monkeypatch.setattr(os, "sched_getaffinity", lambda process_id: {0, 1})
    with_process = outcome("with")
    assert outcome("again") == with_process
    monkeypatch.setattr(os, "sched_getaffinity", lambda process_id: {0})
    monkeypatch.setattr(collect_ahead, "ForkedWorker", None)
    assert outcome("without") == with_process


@pytest.mark.full
def test_a_run_whose_process_is_killed_says_so_and_goes_on(
    tiny_rainbow, rows_of, evaluation_of, monkeypatch
):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process_id: {0, 1})
    whole = run_experiment(tiny_rainbow("name=whole", "budget.agent_steps=400"))
    append, rows = MetricsTable.append, 0

    def append_and_kill(table, row):
        nonlocal rows
        append(table, row)
        rows += 1
        if rows == 5:
            kill_worker()

    options = ("name=killed", "budget.agent_steps=400", "checkpoint.interval_s=0")
    with monkeypatch.context() as patch:
        patch.setattr(MetricsTable, "append", append_and_kill)
        says = r"seed_0: .*killed by SIGKILL.* The same command goes on"
        with pytest.raises(WorkerDiedError, match=says):
            run_experiment(tiny_rainbow(*options))
    killed = run_experiment(tiny_rainbow(*options))
    assert rows_of(killed) == rows_of(whole)
    assert evaluation_of(killed)["params_sha256"] == evaluation_of(whole)["params_sha256"]
    assert not multiprocessing.active_children()
