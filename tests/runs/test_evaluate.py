"""Held-out evaluation against a plain loop; policies on disk."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

import gdrl_tasks
from gdrl_tasks import Outcome, Stream, make_task
from gdrl_tasks.seeds import stream_of
from gdrl_torchrl.agents.rainbow.network import make_q_actor
from gdrl_torchrl.agents.registry import make_actor
from gdrl_torchrl.config.schema import EvaluationConfig
from gdrl_torchrl.evolution.operators.genome import install
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from gdrl_torchrl.files.policy import load_policy, params_sha256, save_policy
from gdrl_torchrl.runs.evaluate import (
    evaluate_kept,
    evaluate_policy,
    greedy_act,
    held_out_seeds,
)
from gdrl_torchrl.runs.kept_policies import COSTS, KeptPolicies
from tests.small import EASY_WATER, compose

OUTCOMES = {
    "success_rate": Outcome.SUCCESS,
    "collision_rate": Outcome.COLLISION,
    "timeout_rate": Outcome.TIMEOUT,
    "capsized_rate": Outcome.CAPSIZED,
    "diverged_rate": Outcome.DIVERGED,
}


def play(task, actor, seed):
    """Outcome, return, steps, way travelled and shortest way of one episode."""
    worlds = gdrl_tasks.BatchSimulation(task, 1, num_threads=1, seed=0)
    observation = worlds.reset(seeds=np.array([seed]))
    goal = worlds.arrays["goal"][0].copy()
    place, way, total, steps = np.zeros(2), 0.0, 0.0, 0
    outcome = Outcome.RUNNING
    while outcome == Outcome.RUNNING:
        row = TensorDict(observation=torch.tensor(observation[0], dtype=torch.float32))
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            action = actor(row)["action"].numpy()
        result = worlds.step(action[None])
        observation, outcome = result.observation, Outcome(int(result.outcome[0]))
        there = worlds.arrays["position"][0].copy()
        way += math.dist(there, place)
        place, total, steps = there, total + float(result.reward[0]), steps + 1
    worlds.close()
    return outcome, total, steps, way, math.hypot(*goal) - task.goal_tolerance_m


def test_the_evaluation_equals_a_plain_loop(actor_of, population_of, easy_task_for):
    task = easy_task_for()
    actor = actor_of("tanh_normal")
    config = EvaluationConfig(episodes=9, num_worlds=4)
    # A member that reaches some of the goals, found among strong mutants.
    from gdrl_torchrl.evolution.operators.genome import install

    population = population_of(actor, 8)
    best = None
    for number in range(8):
        install(actor, population[number])
        scores = evaluate_policy(task, actor, config, num_threads=1)
        if 0.0 < scores["success_rate"] < 1.0:
            best = scores
            break
    assert best is not None, "some goals must be reached and some missed"
    played = [play(task, actor, int(seed)) for seed in held_out_seeds(config)]
    outcomes = [p[0] for p in played]
    for name, outcome in OUTCOMES.items():
        assert best[name] == pytest.approx(outcomes.count(outcome) / 9), name
    spl = [
        shortest / max(shortest, way) if outcome == Outcome.SUCCESS else 0.0
        for outcome, _, _, way, shortest in played
    ]
    steps = [p[2] for p in played]
    seconds = [task.spec.control_interval_s * n for n in steps]
    assert best["episodes"] == 9
    assert best["spl"] == pytest.approx(np.mean(spl), abs=1e-4)
    assert best["return_mean"] == pytest.approx(np.mean([p[1] for p in played]), abs=1e-4)
    assert best["steps_mean"] == pytest.approx(np.mean(steps))
    assert best["time_s_mean"] == pytest.approx(np.mean(seconds))
    assert best["speed_m_s_mean"] == pytest.approx(
        sum(p[3] for p in played) / sum(seconds), abs=1e-4
    )


def test_both_modes_are_evaluated_on_the_same_worlds(actor_of, easy_task_for):
    task, config = easy_task_for(), EvaluationConfig(episodes=40, num_worlds=20)
    actor = actor_of("tanh_normal")
    parameters = dict(actor.named_parameters())
    [scale] = [p for name, p in parameters.items() if "state_independent_scale" in name]
    with torch.no_grad():
        # Next to no noise: to sample is to be greedy.
        scale.fill_(-20.0)
    scores = evaluate_policy(task, actor, config, num_threads=1)
    assert scores["success_rate_sampled"] == scores["success_rate"]
    with torch.no_grad():
        scale.fill_(1.0)
    noisy, again = (evaluate_policy(task, actor, config, num_threads=n) for n in (1, 2))
    assert noisy == again
    assert noisy["success_rate"] == scores["success_rate"]
    assert noisy["success_rate_sampled"] != scores["success_rate_sampled"]


def test_a_deterministic_policy_is_run_once_and_a_noisy_one_in_both_modes(monkeypatch):
    task = make_task("water", **EASY_WATER, actions="discrete")
    runs, evaluate = [], PopulationEvaluator.evaluate

    def counted(self, population, **options):
        runs.append(self.exploration_type)
        return evaluate(self, population, **options)

    monkeypatch.setattr(PopulationEvaluator, "evaluate", counted)
    config = EvaluationConfig(episodes=40, num_worlds=20)
    for noisy, modes in ((False, ["DETERMINISTIC"]), (True, ["DETERMINISTIC", "RANDOM"])):
        actor = make_q_actor(
            task.spec.observation_size,
            7,
            value_range=(-1.0, 1.0),
            noisy=noisy,
            noisy_std=5.0,
        )
        scores = evaluate_policy(task, actor, config, num_threads=1)
        assert [mode.name for mode in runs] == modes
        runs.clear()
        alike = scores["success_rate_sampled"] == scores["success_rate"]
        assert alike is not noisy


def test_a_policy_of_several_marks_has_one_result_and_others_their_own(
    actor_of, easy_task_for
):
    task, actor, spent = easy_task_for(), actor_of("tanh_normal"), {}
    kept = KeptPolicies(4, 100, actor, lambda: dict.fromkeys(COSTS, 0.0) | spent)
    for steps in (25, 40, 100):
        spent["total_steps"] = steps
        for parameter in actor.parameters():
            nn.init.normal_(parameter)
        kept()
    config = compose(["experiment=gppo_water"])
    config.evaluation.episodes, config.evaluation.num_worlds = 40, 20
    points = evaluate_kept(task, actor, kept, config)
    assert [point["total_steps"] for point in points] == [25, 40, 40, 100]
    assert [point["point"] for point in points] == [1, 2, 3, 4]
    rates = []
    for genome in kept.genomes():
        install(actor, genome)
        rates.append(evaluate_policy(task, actor, config.evaluation)["success_rate"])
    assert [point["success_rate"] for point in points] == rates
    assert len(set(rates)) == 3


def test_held_out_worlds_are_apart_from_training_and_fitness():
    seeds = held_out_seeds(EvaluationConfig(episodes=50, seed=0))
    assert (stream_of(seeds) == Stream.EVALUATION).all()
    assert len(set(seeds.tolist())) == 50
    others = held_out_seeds(EvaluationConfig(episodes=50, seed=1))
    assert not set(seeds.tolist()) & set(others.tolist())
    longer = held_out_seeds(EvaluationConfig(episodes=60, seed=0))
    assert (longer[:50] == seeds).all()


def test_the_greedy_policy_takes_arrays(actor_of):
    act = greedy_act(actor_of("tanh_normal"))
    observation = np.random.default_rng(0).normal(size=(5, 3))
    action = act(observation)
    assert isinstance(action, np.ndarray)
    assert action.shape == (5, 2)
    assert (act(observation) == action).all(), "no exploration"


@pytest.fixture
def saved(tmp_path, easy_task_for, tiny):
    task = easy_task_for()
    config = tiny()
    actor = make_actor(task, config.network, config.algorithm)
    save_policy(tmp_path / "final", actor, task, config.algorithm_label)
    return tmp_path / "final", actor, task


def test_a_saved_policy_comes_back_bit_by_bit(saved, tiny):
    folder, actor, task = saved
    other = make_actor(task, tiny().network, tiny().algorithm)
    assert params_sha256(other) != params_sha256(actor)
    load_policy(folder, other)
    assert params_sha256(other) == params_sha256(actor)
    for name, value in actor.state_dict().items():
        assert (other.state_dict()[name] == value).all()


def test_the_digest_sees_every_value(saved):
    _, actor, _ = saved
    digests = {params_sha256(actor)}
    for parameter in actor.parameters():
        with torch.no_grad():
            parameter.view(-1)[-1] += 1e-3
        digests.add(params_sha256(actor))
    assert len(digests) == 1 + len(list(actor.parameters()))


def test_a_policy_of_another_network_is_refused(saved, tiny):
    folder, _, task = saved
    config = tiny("network.actor_cells=[4]")
    other = make_actor(task, config.network, config.algorithm)
    with pytest.raises(ValueError, match=r"policy\.safetensors cannot be loaded"):
        load_policy(folder, other)


@pytest.mark.parametrize("damage", ["missing", "short", "noise"])
def test_a_policy_file_that_is_damaged_is_named(damage, saved):
    folder, actor, _ = saved
    path = folder / "policy.safetensors"
    if damage == "missing":
        path.unlink()
    else:
        content = path.read_bytes()
        path.write_bytes(content[:40] if damage == "short" else b"\x07" * len(content))
    with pytest.raises(ValueError, match=r"policy\.safetensors cannot be loaded"):
        load_policy(folder, actor)


def test_looking_at_a_policy_changes_none_of_its_statistics():
    network = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 2)).train()
    actor = TensorDictModule(network, ["observation"], ["action"])
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    greedy_act(actor)(np.random.default_rng(0).normal(size=(6, 3)))
    assert all(torch.equal(actor.state_dict()[n], value) for n, value in before.items())
