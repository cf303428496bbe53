"""The PPO agent: what collects, and what learns."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from gdrl_tasks import NavigationTask
from gdrl_torchrl.agents.base import ACTIVATIONS, Agent, MakeEnv
from gdrl_torchrl.agents.collectors.navigation import make_collector
from gdrl_torchrl.agents.networks import make_tanh_normal_actor, make_value_network
from gdrl_torchrl.agents.ppo.loss import make_ppo_loss
from gdrl_torchrl.agents.ppo.settings import PPOConfig
from gdrl_torchrl.agents.settings import NetworkConfig, check_actions
from gdrl_torchrl.agents.update import Update

_ENTROPY_OF_UNIT_NORMAL = 0.5 * math.log(2.0 * math.pi * math.e)


def make_ppo_actor(
    task: NavigationTask, network: NetworkConfig, settings: Any
) -> ProbabilisticActor:
    """The policy of a run.

    Raises:
        ValueError: If the task's actions are discrete.
    """
    check_actions(task, settings)
    size = task.spec.action_size
    return make_tanh_normal_actor(
        task.spec.observation_size,
        Bounded(low=-1.0, high=1.0, shape=torch.Size([size]), dtype=torch.float32),
        num_cells=tuple(network.actor_cells),
        activation=ACTIVATIONS[network.activation],
        initial_std=network.initial_std,
    )


class PPOLearner:
    """Estimates advantages in every epoch, and makes one update per minibatch.

    As TorchRL's ``PPOTrainer`` does; but that puts the whole batch into a replay buffer in
    every epoch, with all that nobody reads. Advantages of the critic before the first
    epoch are cheaper, and two of five seeds then learnt to cross waves late or never.

    Args:
        loss: The loss.
        advantage: Writes what the loss reads into batches ``[W, T]``.
        optimizer: Optimiser of the loss's parameters.
        config: PPO's settings.
        seed: Seed of the order of minibatches.
        on_non_finite: As of :class:`~gdrl_torchrl.agents.update.Update`.
    """

    def __init__(
        self,
        loss: ClipPPOLoss,
        advantage: GAE,
        optimizer: torch.optim.Optimizer,
        config: PPOConfig,
        *,
        seed: int,
        on_non_finite: str = "stop",
    ) -> None:
        self.advantage = advantage
        self.minibatch_size = config.minibatch_size
        self.generator = torch.Generator().manual_seed(seed)
        names: Any = loss.tensor_keys
        read = [*loss.actor_network.in_keys, *loss.critic_network.in_keys]
        read += [names.action, names.sample_log_prob]
        read += [names.advantage, names.value_target, names.value]
        self._keys = list(dict.fromkeys(read))
        self.update = Update(
            loss,
            optimizer,
            config.max_grad_norm,
            diagnostics=["kl_approx", "clip_fraction", "explained_variance"],
            noted=["entropy"],
            on_non_finite=on_non_finite,
        )
        self.updates = [self.update]
        self.num_epochs = config.num_epochs

    def learn(self, batch: TensorDictBase) -> None:
        """Make the updates of all epochs of a batch ``[W, T]``.

        Raises:
            NonFiniteUpdateError: If something in one is not finite.
        """
        self._note_entropy(batch)
        for epoch in range(self.num_epochs):
            # Of the last epoch: how far the policy has come from the one that collected.
            diagnose = epoch == self.num_epochs - 1
            for minibatch in self.minibatches(batch):
                self.update(minibatch, diagnose=diagnose)

    def minibatches(self, batch: TensorDictBase) -> tuple[TensorDictBase, ...]:
        """Those of an epoch: rows in a new order, with new advantages."""
        rows = self.advantage(batch).select(*self._keys).reshape(-1)
        order = torch.randperm(len(rows), generator=self.generator)
        return rows[order].split(self.minibatch_size)

    @torch.no_grad()
    def _note_entropy(self, batch: TensorDictBase) -> None:
        """Of the normal distribution that actions are drawn from before they are squashed.

        That of the squashed one has no formula: to sample it would take random numbers
        that the run then lacks.
        """
        logarithms = batch["scale"].log().sum(-1).mean()
        offset = _ENTROPY_OF_UNIT_NORMAL * batch["scale"].shape[-1]
        self.update.means.add([("entropy", logarithms + offset)])

    def state_dict(self) -> dict[str, Any]:
        """Generator of the order, and a counter."""
        return {
            "generator": self.generator.get_state(),
            "num_skipped": self.update.num_skipped,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.generator.set_state(state_dict["generator"])
        self.update.num_skipped = state_dict["num_skipped"]


def make_ppo_agent(
    task: NavigationTask,
    network: NetworkConfig,
    settings: PPOConfig,
    *,
    make_env: MakeEnv,
    seed: int = 0,
    on_non_finite: str = "stop",
) -> Agent:
    """Build the agent, with its worlds.

    Args:
        task: The task.
        network: Sizes of policy and critic.
        settings: PPO's settings.
        make_env: Makes the environment of so many worlds that the collector steps.
        seed: Seed of the order of minibatches; weights are those of torch's generator.
        on_non_finite: As of :class:`~gdrl_torchrl.agents.update.Update`.

    Raises:
        ValueError: If the task's actions are discrete.
    """
    env = make_env(settings.num_worlds)
    actor = make_ppo_actor(task, network, settings)
    critic = make_value_network(
        task.spec.observation_size,
        num_cells=tuple(network.critic_cells),
        sees_time=network.critic_sees_time,
        activation=ACTIVATIONS[network.activation],
    )
    loss, advantage = make_ppo_loss(actor, critic, settings)
    optimizer = torch.optim.Adam(
        loss.parameters(), lr=settings.learning_rate, eps=1e-5, fused=True
    )
    collector = make_collector(
        env,
        actor,
        frames_per_batch=settings.frames_per_batch,
        policy_keys=["action_log_prob", "loc", "scale"],
    )
    learner = PPOLearner(
        loss,
        advantage,
        optimizer,
        settings,
        seed=seed,
        on_non_finite=on_non_finite,
    )
    return Agent(
        actor,
        learner,
        collector,
        loss=loss,
        optimizer=optimizer,
        critic=critic,
    )
