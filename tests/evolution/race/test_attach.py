"""A race on TorchRL's own trainers."""

from __future__ import annotations

import warnings

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import Compose, GymEnv, RewardScaling, RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.modules import (
    MLP,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import SACLoss
from torchrl.trainers.algorithms import SACTrainer

from gdrl_torchrl.envs.success import ReturnSuccess
from gdrl_torchrl.evolution.operators.genome import genome_of
from gdrl_torchrl.evolution.race.attach import AttachedRaceHook
from tests.evolution.hooks.attached.trainers import trainer_of

SMALL = {"num_members": 4, "num_trials": 2, "least_success": 0.5, "race_below": 1.0}
SMALL |= {"num_distilled": 1, "distillation_updates": 5, "patience_episodes": 2}


def pendulum(threshold=200.0):
    """Its reward is above 0 here, and all episodes of 20 steps are a success."""
    scaled = RewardScaling(loc=20.0, scale=1.0)
    return TransformedEnv(
        GymEnv("Pendulum-v1"), Compose(scaled, RewardSum(), ReturnSuccess(threshold))
    )


def make_sac(frames=300):
    torch.manual_seed(0)
    # The agent never succeeds, whatever it does.
    env = pendulum(1e6)
    network = nn.Sequential(
        MLP(in_features=3, out_features=2, num_cells=[8]), NormalParamExtractor()
    )
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -2.0, "high": 2.0},
        default_interaction_type=ExplorationType.RANDOM,
    )
    critic = ValueOperator(
        MLP(in_features=4, out_features=1, num_cells=[8]), in_keys=["observation", "action"]
    )
    loss = SACLoss(actor, critic, action_spec=env.action_spec)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return trainer_of(SACTrainer, loss, actor, env, frames=frames), actor


def test_it_finds_the_policy_of_a_stock_trainer_and_hands_over():
    trainer, actor = make_sac()
    heard = []
    hook = AttachedRaceHook(
        create_env_fn=pendulum, max_steps=20, on_evaluation=[heard.append], **SMALL
    )
    first = genome_of(actor)
    hook.register(trainer)
    assert "race_hook" in trainer.state_dict()
    trainer.train()
    race = hook.race
    assert race is not None
    assert race.actor is actor
    assert race.counts.switches >= 1
    assert race.counts.steps == sum(e.population_steps for e in heard) > 0
    assert not (genome_of(actor) == first).all()


def test_an_environment_without_a_flag_is_refused_when_it_is_played_in():
    trainer, _ = make_sac()
    hook = AttachedRaceHook(create_env_fn=lambda: GymEnv("Pendulum-v1"), **SMALL)
    hook.register(trainer)
    assert hook.race is not None
    with pytest.raises(ValueError, match="needs the entry 'success'"):
        hook.race.evaluate()


def test_there_is_no_state_before_it_is_registered():
    hook = AttachedRaceHook(create_env_fn=pendulum)
    with pytest.raises(RuntimeError, match="before register"):
        hook.state_dict()


def test_a_setting_that_is_none_is_refused():
    with pytest.raises(TypeError, match="num_children"):
        AttachedRaceHook(create_env_fn=pendulum, num_children=3)
