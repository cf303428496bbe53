"""What ``PopulationEvaluator`` promises, against oracles that share no code with it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

import gdrl_tasks
from gdrl_tasks import Outcome, Stream
from gdrl_tasks.seeds import stream_of
from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator
from tests.marks import full_but

QUICK = ("tanh_normal", "distributional")


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


@pytest.mark.parametrize(
    "actor_kind",
    full_but(QUICK, [*QUICK, "deterministic", "sequential", "q_value"]),
    indirect=True,
)
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


@pytest.mark.parametrize("worlds", [1, 4, 7, 12, 40])
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


# Members whose numbers are not numbers


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


def test_members_that_sample_depend_on_the_episodes_alone(
    actor_of, population_of, evaluator_for
):
    actor = actor_of("tanh_normal")
    population, seeds = population_of(actor, 2), torch.tensor([3, 4])
    evaluator = evaluator_for(
        actor, 2, num_episodes=2, exploration_type=ExplorationType.RANDOM
    )
    found = []
    for number in range(2):
        torch.manual_seed(number)
        before = torch.get_rng_state()
        found.append(evaluator.evaluate(population, seeds=seeds)["returns"])
        assert (torch.get_rng_state() == before).all(), "no draw of others changes"
    assert (found[0] == found[1]).all()
    greedy = evaluator_for(actor, 2, num_episodes=2)
    assert (greedy.evaluate(population, seeds=seeds)["returns"] != found[0]).any()


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
