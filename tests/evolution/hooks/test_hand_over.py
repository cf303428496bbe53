"""What a switch touches: weights, the optimiser's moments, the critic, the collector."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP, ActorValueOperator, ValueOperator

from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.runs.build import build_training
from gdrl_torchrl.runs.checkpoint import seed_everything
from tests.evolution.hooks.scripted import (
    CHILD_WINS,
    PARENT_WINS,
    ScriptedEvaluator,
    hook_of,
)


def test_the_winner_is_written_into_the_same_parameter_objects(actor):
    evaluator = ScriptedEvaluator(CHILD_WINS)
    objects = {name: id(value) for name, value in actor.named_parameters()}
    scale = actor.module[0].module[-1].state_independent_scale.clone()
    hook = hook_of(actor, evaluator)
    result = hook.evaluate()
    assert result.winner == 2
    assert {name: id(value) for name, value in actor.named_parameters()} == objects
    assert (genome_of(actor) == evaluator.populations[0][2]).all()
    assert (actor.module[0].module[-1].state_independent_scale == scale).all()
    assert (hook.counts.evaluations, hook.counts.switches) == (1, 1)


def test_a_parent_that_wins_is_left_alone(actor):
    genome = genome_of(actor)
    optimizer = torch.optim.Adam(actor.parameters())
    take_a_step(actor, optimizer, weight=0.0)
    hook = hook_of(
        actor,
        ScriptedEvaluator(PARENT_WINS),
        optimizer=optimizer,
        optimizer_on_switch="reset",
    )
    moments = len(optimizer.state)
    assert not hook.evaluate().switched
    assert (genome_of(actor) == genome).all()
    assert len(optimizer.state) == moments > 0
    assert hook.counts.switches == 0


def take_a_step(module, optimizer, *, weight=1.0):
    optimizer.zero_grad()
    sum(weight * p.square().sum() for p in module.parameters()).backward()
    optimizer.step()


@pytest.mark.parametrize("choice", ["keep", "reset"])
def test_the_moments_of_the_actor_alone_are_reset_on_a_switch(choice, tiny):
    seed_everything(0)
    training = build_training(tiny(f"evolution.optimizer_on_switch={choice}"))
    training.agent.learner.learn(next(iter(training.agent.collector)))
    optimizer, hook = training.agent.optimizer, training.evolution
    actor = {id(p) for p in training.agent.actor.parameters()}
    before = {id(p) for p in optimizer.state}
    assert actor < before, "the optimiser holds the actor's own parameters"
    hook.evaluator = ScriptedEvaluator(CHILD_WINS)
    assert hook.evaluate().switched
    after = {id(p) for p in optimizer.state}
    assert after == (before if choice == "keep" else before - actor)
    take_a_step(training.agent.loss, optimizer)
    training.close()


@pytest.mark.parametrize("choice", ["keep", "reset"])
def test_the_critic_is_kept_or_begun_anew(choice, actor):
    critic = ValueOperator(MLP(in_features=3, out_features=1, num_cells=[4]))
    before = {name: p.clone() for name, p in critic.named_parameters()}
    objects = [id(p) for p in critic.parameters()]
    hook = hook_of(
        actor, ScriptedEvaluator(CHILD_WINS), critic=critic, critic_on_switch=choice
    )
    hook.evaluate()
    kept = all((p == before[name]).all() for name, p in critic.named_parameters())
    assert kept == (choice == "keep")
    assert [id(p) for p in critic.parameters()] == objects


@pytest.mark.parametrize("choice", ["keep", "reset"])
def test_a_trunk_that_actor_and_critic_share_is_the_winners(choice):
    trunk = TensorDictModule(MLP(3, 8, num_cells=[8]), ["observation"], ["hidden"])
    policy = TensorDictModule(nn.Linear(8, 2), ["hidden"], ["action"])
    value = ValueOperator(MLP(8, 1, num_cells=[4]), in_keys=["hidden"])
    model = ActorValueOperator(trunk, policy, value)
    actor, critic = model.get_policy_operator(), model.get_value_operator()
    before = {name: p.clone() for name, p in value.named_parameters()}
    evaluator = ScriptedEvaluator(CHILD_WINS)
    hook = hook_of(actor, evaluator, critic=critic, critic_on_switch=choice)
    assert hook.evaluate().switched
    winner, now = evaluator.populations[0][2], genome_of(actor)
    assert (now == winner).all()
    kept = all((p == before[name]).all() for name, p in value.named_parameters())
    assert kept == (choice == "keep")


def test_a_critic_that_has_no_layer_of_its_own_cannot_be_reset(actor):
    with pytest.raises(ValueError, match="no layers to reset that are not the actor's"):
        hook_of(actor, ScriptedEvaluator(), critic=actor, critic_on_switch="reset")


def test_the_collector_acts_with_the_new_weights(tiny):
    seed_everything(0)
    training = build_training(tiny())
    training.evolution.evaluator = ScriptedEvaluator(CHILD_WINS)
    batches = iter(training.agent.collector)
    next(batches)
    before = genome_of(training.agent.actor)
    assert training.evolution.evaluate().switched
    batch = next(batches)
    observation = batch["observation"]
    new = training.agent.actor.get_dist_params(
        TensorDict(observation=observation, batch_size=observation.shape[:-1])
    )["loc"]
    assert torch.allclose(batch["loc"], new, atol=1e-6)
    assert not (genome_of(training.agent.actor) == before).all()
    training.close()
