"""The Rainbow agent of a run: network, loss, replay buffer and collector."""

from __future__ import annotations

import functools
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.data import Categorical
from torchrl.modules import DistributionalQValueActor, EGreedyModule

from gdrl_tasks import NavigationTask
from gdrl_tasks.processors import allowed_processors
from gdrl_torchrl.agents.base import ACTIVATIONS, Agent, MakeEnv
from gdrl_torchrl.agents.collectors.ahead import AheadCollector
from gdrl_torchrl.agents.collectors.collects import Collects, EnvCollector
from gdrl_torchrl.agents.collectors.navigation import make_collector
from gdrl_torchrl.agents.rainbow.learner import RainbowLearner
from gdrl_torchrl.agents.rainbow.loss import RainbowLoss, soft_update_target
from gdrl_torchrl.agents.rainbow.network import make_q_actor
from gdrl_torchrl.agents.rainbow.replay import make_prioritized_buffer
from gdrl_torchrl.agents.rainbow.settings import RainbowConfig
from gdrl_torchrl.agents.settings import NetworkConfig, check_actions

_OTHER_DRAWS = 1 << 41
"""Added to a run's seed for what acts ahead, beside what learns."""


def make_rainbow_actor(
    task: NavigationTask, network: NetworkConfig, settings: RainbowConfig
) -> DistributionalQValueActor:
    """The greedy policy of a run; its support holds every return of the task.

    Raises:
        ValueError: If the task's actions are continuous.
    """
    check_actions(task, settings)
    return make_q_actor(
        task.spec.observation_size,
        task.spec.action_size,
        value_range=task.spec.return_range(settings.gamma),
        num_atoms=settings.num_atoms,
        num_cells=tuple(network.actor_cells),
        activation=ACTIVATIONS[network.activation],
        noisy=settings.exploration == "noisy",
        noisy_std=settings.noisy_std,
    )


def make_rainbow_agent(
    task: NavigationTask,
    network: NetworkConfig,
    settings: RainbowConfig,
    *,
    make_env: MakeEnv,
    seed: int = 0,
    on_non_finite: str = "stop",
) -> Agent:
    """Build the agent, with its worlds.

    Args:
        task: The task.
        network: Size of the network.
        settings: Rainbow's settings.
        make_env: Makes the environment of so many worlds that the collector steps.
        seed: Seed of replay and of what is drawn while collecting ahead; weights are
            those of torch's generator.
        on_non_finite: As of :class:`~gdrl_torchrl.agents.update.Update`.

    Raises:
        ValueError: If the task's actions are continuous.
    """
    actor = make_rainbow_actor(task, network, settings)
    loss = RainbowLoss(actor, gamma=settings.gamma)
    optimizer = torch.optim.Adam(
        list(loss.parameters()), lr=settings.learning_rate, eps=1e-4, fused=True
    )
    buffer = make_prioritized_buffer(
        settings.replay_capacity,
        alpha=settings.replay_alpha,
        beta=settings.replay_beta,
        batch_size=settings.minibatch_size,
        seed=seed,
    )
    exploration = None
    policy: Any = actor
    if settings.exploration == "epsilon_greedy":
        exploration = EGreedyModule(
            Categorical(task.spec.action_size),
            eps_init=settings.epsilon_start,
            eps_end=settings.epsilon_end,
        )
        modules: list[Any] = [actor, exploration]
        policy = TensorDictSequential(*modules)
    learner = RainbowLearner(
        loss,
        optimizer,
        buffer,
        settings,
        seed=seed,
        exploration=exploration,
        on_non_finite=on_non_finite,
    )
    return Agent(
        actor,
        learner,
        _make_collector(task, policy, settings, make_env, seed),
        loss=loss,
        optimizer=optimizer,
        follow_switch=functools.partial(soft_update_target, loss),
        share_experience=learner.share,
    )


def _make_collector(
    task: NavigationTask,
    policy: TensorDictModuleBase,
    settings: RainbowConfig,
    make_env: MakeEnv,
    seed: int,
) -> Collects:
    def make() -> EnvCollector:
        return make_collector(
            make_env(settings.num_worlds),
            policy,
            frames_per_batch=settings.frames_per_batch,
            policy_keys=[],
        )

    if not settings.collect_ahead:
        return make()
    # Both sides will need the compiled functions, which take a moment to load.
    task.draw_episode(seed)
    return AheadCollector(
        make,
        policy,
        seed=seed + _OTHER_DRAWS,
        # On one processor the two sides would only take turns.
        in_process=allowed_processors() > 1,
    )
