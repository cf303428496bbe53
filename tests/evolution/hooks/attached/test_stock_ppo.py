"""The genetic hook on TorchRL's own trainer of PPO."""

from __future__ import annotations

import warnings

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import GymEnv
from torchrl.modules import MLP, OneHotCategorical, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms import PPOTrainer

from gdrl_torchrl.evolution.hooks.breeding import MutatedChildren
from gdrl_torchrl.evolution.hooks.contest import FullContest
from gdrl_torchrl.evolution.hooks.genetic import GeneticHook
from gdrl_torchrl.evolution.hooks.watch import EpisodeWatch
from gdrl_torchrl.evolution.population.evaluator import PopulationEvaluator


def test_it_registers_on_torchrls_own_ppo_trainer():
    torch.manual_seed(0)
    env = GymEnv("CartPole-v1")
    network = MLP(in_features=4, out_features=2, num_cells=[8])
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits"],
        spec=env.action_spec,
        distribution_class=OneHotCategorical,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(in_features=4, out_features=1, num_cells=[8]))
    loss = ClipPPOLoss(actor, critic)
    evaluator = PopulationEvaluator(
        actor,
        num_episodes=2,
        create_env_fn=lambda: GymEnv("CartPole-v1"),
        max_steps=25,
        fitness="return",
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer = PPOTrainer(
            collector=Collector(env, actor, frames_per_batch=100, total_frames=300),
            total_frames=300,
            frame_skip=1,
            optim_steps_per_batch=None,
            loss_module=loss,
            optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
            num_epochs=1,
            replay_buffer=TensorDictReplayBuffer(
                storage=LazyTensorStorage(100),
                sampler=SamplerWithoutReplacement(),
                batch_size=50,
            ),
            gae=GAE(gamma=0.99, lmbda=0.95, value_network=critic),
            enable_logging=False,
            progress_bar=False,
        )
    heard = []
    hook = GeneticHook(
        actor,
        evaluator,
        MutatedChildren(2),
        FullContest("child"),
        period_episodes=2,
        watch=EpisodeWatch(3),
        on_evaluation=[heard.append],
    )
    hook.register(trainer)
    assert any("genetic_hook" in str(key) for key in _keys(trainer.state_dict()))
    trainer.train()
    assert hook.watch.episodes_completed >= 6
    assert 2 <= len(heard) <= 3, "at most one evaluation a batch"
    assert hook.counts.steps == sum(e.population_steps for e in heard) > 0
    assert all((e.scores["steps"] <= 25).all() for e in heard)
    assert hook.counts.switches == sum(e.switched for e in heard)
    evaluator.close()


def _keys(state):
    for key, value in state.items():
        yield key
        if isinstance(value, dict):
            yield from _keys(value)
