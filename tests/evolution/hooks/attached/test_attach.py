"""The hook that finds the agent: what follows a switch, its options and its state."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import DDPGLoss, SACLoss
from torchrl.trainers.algorithms import DDPGTrainer, SACTrainer

from gdrl_torchrl.evolution.hooks.attach import AttachedGeneticHook
from gdrl_torchrl.evolution.hooks.contest import Verdict
from gdrl_torchrl.evolution.operators.mutation import scaled_mutation
from tests.evolution.hooks.attached.trainers import (
    action_value,
    cartpole,
    hook_for,
    make_dqn,
    pendulum,
    trainer_of,
)

pytestmark = pytest.mark.usefixtures("quiet")


@pytest.fixture
def sac(actor_of):
    """SAC whose collector has a policy of its own, as one of configurations has."""
    actor = actor_of("tanh_normal", 3, pendulum().action_spec)
    loss = SACLoss(actor, action_value(), target_entropy=-1.0)
    return trainer_of(SACTrainer, loss, copy.deepcopy(actor), pendulum()), actor


@pytest.fixture
def ddpg(actor_of):
    """DDPG, whose actor has a delayed copy."""
    env = pendulum()
    actor = actor_of("deterministic", 3, env.action_spec)
    loss = DDPGLoss(actor, action_value(), delay_actor=True, delay_value=True)
    return trainer_of(DDPGTrainer, loss, actor, env), actor


def watch(genetic):
    """Populations that its evaluator is shown."""
    populations, evaluate = [], genetic.evaluator.evaluate

    def watched(params, **options):
        populations.append(params.clone())
        return evaluate(params, **options)

    genetic.evaluator.evaluate = watched
    return populations


def let_win(genetic, winner):
    """Make a member win, whatever it is; the populations that competed."""
    populations = []

    def contest(match):
        populations.append(match.population.clone())
        count = len(match.population)
        scores = TensorDict(
            fitness=torch.zeros(count),
            frames=torch.ones(count, dtype=torch.int64),
            batch_size=[count],
        )
        return Verdict(scores, winner, None)

    genetic.contest = contest
    return populations


def weights(source):
    """Weights by dotted name, copied."""
    named = source.flatten_keys(".") if hasattr(source, "flatten_keys") else None
    items = source.named_parameters() if named is None else named.items()
    return {name: value.detach().clone() for name, value in items}


def same(values, genome):
    """Whether all weights of a genome are exactly among values."""
    wanted = weights(genome)
    assert wanted.keys() <= values.keys()
    return all(torch.equal(values[name], value) for name, value in wanted.items())


# Training


@pytest.mark.parametrize("kind", ["sac", "ddpg"])
def test_a_stock_continuous_trainer_goes_on_with_the_winner(kind, request):
    trainer, actor = request.getfixturevalue(kind)
    hook = hook_for(pendulum)
    switches = []

    def look(found):
        population = populations[-1]
        assert same(weights(actor), population[found.winner])
        switches.append(found.switched)
        scores = found.scores["fitness"]
        assert scores[found.winner] == scores.max()

    hook.register(trainer)
    hook.genetic.on_evaluation.append(look)
    populations = watch(hook.genetic)
    trainer.train()
    # Trajectories of 20 steps: in each of the six batches at least two of them end.
    assert hook.genetic.counts.evaluations == len(switches) == 6
    assert any(switches)
    assert hook.genetic.counts.switches == sum(switches)
    optimised = {id(p) for group in trainer.optimizer.param_groups for p in group["params"]}
    assert {id(parameter) for parameter in actor.parameters()} <= optimised


@pytest.mark.parametrize("kind", ["sac", "dqn"])
def test_a_collector_with_its_own_policy_acts_with_the_winner(kind, request, actor_of):
    if kind == "sac":
        trainer, actor = request.getfixturevalue(kind)
    else:
        trainer, actor = make_dqn(actor_of, apart=True)
    own = trainer.collector.policy if kind == "sac" else trainer.collector.policy[0]
    assert not {p.data_ptr() for p in own.parameters()} & {
        p.data_ptr() for p in actor.parameters()
    }
    hook = hook_for(pendulum if kind == "sac" else cartpole)
    hook.register(trainer)
    populations = let_win(hook.genetic, 2)
    hook.genetic.evaluate()
    assert same(weights(own), populations[0][2])
    assert not same(weights(own), populations[0][0])
    trainer.collector.shutdown()


# The target network


@pytest.mark.parametrize("tau", [0.0, 0.25, 1.0])
def test_the_target_of_the_policy_alone_moves_on_a_switch(tau, ddpg):
    trainer, _ = ddpg
    loss = trainer.loss_module
    # Apart from the network that it is the target of, as after some training.
    loss.target_actor_network_params.apply_(lambda value: value + 1.0)
    before = weights(loss.target_actor_network_params)
    critic = weights(loss.target_value_network_params)
    hook = hook_for(pendulum, target_tau=tau)
    hook.register(trainer)
    populations = let_win(hook.genetic, 1)
    hook.genetic.evaluate()
    after = weights(loss.target_actor_network_params)
    for name, winner in weights(populations[0][1]).items():
        expected = (1.0 - tau) * before[name] + tau * winner
        assert torch.allclose(after[name], expected, atol=1e-6), name
        assert torch.equal(after[name], before[name]) == (tau == 0.0)
    now = weights(loss.target_value_network_params)
    assert all(torch.equal(now[name], value) for name, value in critic.items())
    trainer.collector.shutdown()


def test_a_parent_that_wins_moves_nothing(actor_of):
    trainer, actor = make_dqn(actor_of)
    loss = trainer.loss_module
    loss.target_value_network_params.apply_(lambda value: value + 1.0)
    target, own = weights(loss.target_value_network_params), weights(actor)
    hook = hook_for(cartpole)
    hook.register(trainer)
    let_win(hook.genetic, 0)
    hook.genetic.evaluate()
    now = weights(loss.target_value_network_params)
    assert all(torch.equal(now[name], value) for name, value in target.items())
    assert all(torch.equal(value, own[name]) for name, value in actor.named_parameters())
    trainer.collector.shutdown()


# Options


def test_options_reach_the_hook_and_its_evaluator(actor_of):
    trainer, actor = make_dqn(actor_of)
    env = cartpole()
    heard = []
    hook = AttachedGeneticHook(
        create_env_fn=env,
        num_children=2,
        period_episodes=7,
        num_trials=3,
        max_steps=9,
        fitness="return",
        mutation="scaled",
        mut_v=0.3,
        rates=[0.5, 0.2],
        thresholds=[0.6],
        window_episodes=11,
        success_range=[0.2, 0.9],
        tie_rule="parent",
        own_share=0.25,
        seed=5,
        on_evaluation=[heard.append],
    )
    hook.register(trainer, "evolution")
    genetic, evaluator = hook.genetic, hook.genetic.evaluator
    assert genetic.actor is actor
    assert evaluator.env is env
    breeding = genetic.breeding
    assert (breeding.num_children, genetic.period_episodes) == (2, 7)
    assert (evaluator.num_episodes, evaluator.max_steps) == (3, 9)
    assert (evaluator.fitness, evaluator.seed) == ("return", 5)
    assert (breeding.mutation, breeding.std) == (scaled_mutation, 0.3)
    assert [breeding.schedule(rate) for rate in (0.5, 0.6)] == [0.5, 0.2]
    assert genetic.watch.window.size == 11
    assert genetic.success_range == (0.2, 0.9)
    assert genetic.hand_over.own_share == 0.25
    assert genetic.contest.tie_rule == "parent"
    assert genetic.generator.initial_seed() == 5
    found = genetic.evaluate()
    assert heard == [found]
    assert found.scores["return_mean"].max() <= 9.0
    assert "evolution" in trainer.state_dict()
    trainer.collector.shutdown()


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ({"mutation": "cosmic"}, "mutation='cosmic'"),
        ({"target_tau": 1.5}, "target_tau=1.5"),
        ({"rates": [0.5, 0.1]}, "rates="),
        ({"num_children": 0}, "num_children=0"),
        ({"period_episodes": 0}, "period_episodes=0"),
        ({"num_trials": 0}, "num_trials=0"),
        ({"fitness": "fame"}, "fitness='fame'"),
        ({"own_share": 1.0}, "own_share=1.0"),
    ],
)
def test_bad_options_are_named(option, said, actor_of):
    trainer, _ = make_dqn(actor_of)
    with pytest.raises(ValueError, match=said):
        hook_for(cartpole, **option).register(trainer)
    trainer.collector.shutdown()


# State


def test_a_trainers_file_brings_the_hook_back(actor_of, tmp_path):
    file = str(tmp_path / "trainer.pt")
    first, _ = make_dqn(actor_of, frames=200, save_trainer_file=file)
    one = hook_for(cartpole)
    one.register(first)
    first.train()
    assert one.genetic.counts.evaluations >= 1

    second, actor = make_dqn(actor_of, frames=400)
    two = hook_for(cartpole, seed=99)
    two.register(second)
    assert two.genetic.counts.evaluations == 0
    second.load_from_file(file)
    assert two.genetic.counts == one.genetic.counts
    assert two.genetic.watch.state_dict() == one.genetic.watch.state_dict()
    # The same mutants of the same agent come next.
    assert same(weights(actor), TensorDict.from_module(first.loss_module.value_network))
    expected, shown = let_win(one.genetic, 0), let_win(two.genetic, 0)
    one.genetic.evaluate()
    two.genetic.evaluate()
    assert (shown[0] == expected[0]).all()
    second.collector.shutdown()


def test_the_state_of_the_hook_is_that_of_the_hook_it_made(actor_of):
    trainer, _ = make_dqn(actor_of)
    other, _ = make_dqn(actor_of)
    first, second = hook_for(cartpole), hook_for(cartpole, seed=3)
    with pytest.raises(RuntimeError, match="register"):
        first.state_dict()
    first.register(trainer)
    second.register(other)
    first.genetic.evaluate()
    second.load_state_dict(first.state_dict())
    mine, theirs = second.state_dict(), first.state_dict()
    assert torch.equal(mine.pop("generator"), theirs.pop("generator"))
    assert mine == theirs
    assert mine["counts"]["evaluations"] == 1
    for one in (trainer, other):
        one.collector.shutdown()
