"""Which policy evolves is found in a trainer, or the trainer is refused."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import (
    A2CLoss,
    ClipPPOLoss,
    CQLLoss,
    DDPGLoss,
    DQNLoss,
    IQLLoss,
    ReinforceLoss,
    SACLoss,
    TD3Loss,
)

from gdrl_torchrl.evolution.hooks.attach import find_policy
from tests.evolution.hooks.attached.trainers import (
    action_value,
    cartpole,
    hook_for,
    make_dqn,
    pendulum,
    state_value,
)

pytestmark = pytest.mark.usefixtures("quiet")


def stochastic(actor_of):
    return actor_of("tanh_normal", 3, pendulum().action_spec)


def deterministic(actor_of):
    return actor_of("deterministic", 3, pendulum().action_spec)


def greedy(actor_of):
    return actor_of("q_value", 4, cartpole().action_spec)


LOSSES = {
    "a2c": (stochastic, lambda actor: A2CLoss(actor, state_value())),
    "cql": (stochastic, lambda actor: CQLLoss(actor, action_value())),
    "ddpg": (deterministic, lambda actor: DDPGLoss(actor, action_value())),
    "dqn": (greedy, lambda actor: DQNLoss(actor, action_space="one-hot")),
    "iql": (stochastic, lambda actor: IQLLoss(actor, action_value(), state_value())),
    "ppo": (stochastic, lambda actor: ClipPPOLoss(actor, state_value())),
    "reinforce": (
        stochastic,
        lambda actor: ReinforceLoss(actor, critic_network=state_value()),
    ),
    "sac": (stochastic, lambda actor: SACLoss(actor, action_value())),
    "sac_with_value": (
        stochastic,
        lambda actor: SACLoss(actor, action_value(), state_value()),
    ),
    "td3": (deterministic, lambda a: TD3Loss(a, action_value(), bounds=(-2.0, 2.0))),
}


@pytest.mark.parametrize("name", LOSSES)
def test_the_policy_of_every_stock_loss_is_found(name, actor_of):
    make_actor, make_loss = LOSSES[name]
    actor = make_actor(actor_of)
    loss = make_loss(actor)
    found = getattr(loss, find_policy(loss))
    learns = {parameter.data_ptr() for parameter in loss.parameters()}
    assert {p.data_ptr() for p in found.parameters()} <= learns
    assert {id(p) for p in found.parameters()} == {id(p) for p in actor.parameters()}


class OddLoss(nn.Module):
    """A loss with something under the name of the actor."""

    def __init__(self, actor):
        super().__init__()
        self.layer = nn.Linear(3, 1)
        self.value_network = state_value()
        self.__dict__["actor_network"] = actor


def other_policy():
    return TensorDictModule(nn.Linear(3, 2), ["observation"], ["action"])


@pytest.mark.parametrize(
    "loss",
    [nn.Linear(3, 1), OddLoss(other_policy()), OddLoss(nn.Linear(3, 1)), lambda td: td],
    ids=["no_names", "not_trained", "not_of_tensordicts", "function"],
)
def test_without_a_policy_that_learns_it_is_refused(loss):
    hook = hook_for(pendulum)
    with pytest.raises(ValueError, match="actor_network or value_network"):
        hook.register(SimpleNamespace(loss_module=loss))
    assert hook.genetic is None


def test_weights_in_other_processes_are_refused():
    trainer = SimpleNamespace(learner_backend="ray", loss_module=nn.Linear(3, 1))
    with pytest.raises(ValueError, match="learner_backend='ray'"):
        hook_for(pendulum).register(trainer)


def test_asynchronous_collection_is_refused(actor_of):
    trainer, _ = make_dqn(actor_of)
    trainer.async_collection = True
    hook = hook_for(cartpole)
    with pytest.raises(ValueError, match="async_collection"):
        hook.register(trainer)
    assert hook.genetic is None
    trainer.collector.shutdown()
