"""What a Rainbow agent learns from a batch: a full replay buffer and a few updates."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.modules import EGreedyModule

from gdrl_torchrl import keys
from gdrl_torchrl.agents.rainbow.loss import RainbowLoss, resample_noise, target_and_online
from gdrl_torchrl.agents.rainbow.n_step import NStep
from gdrl_torchrl.agents.rainbow.replay import draw_minibatch, note_errors
from gdrl_torchrl.agents.rainbow.replay_state import buffer_state, load_buffer_state
from gdrl_torchrl.agents.rainbow.settings import RainbowConfig
from gdrl_torchrl.agents.rainbow.shared_experience import share_experience
from gdrl_torchrl.agents.update import Update


class RainbowLearner:
    """Feeds the replay buffer, and makes a few updates per batch.

    An update is loss, gradient, target network, noise, priorities and the annealing of
    beta, in this order.

    Args:
        loss: The loss, with its target network.
        optimizer: Optimiser of its parameters.
        buffer: The prioritised buffer.
        config: Rainbow's settings.
        seed: Seed of the choice among other policies' transitions.
        exploration: The module whose epsilon decays, if there is one.
        on_non_finite: As of :class:`~gdrl_torchrl.agents.update.Update`.
    """

    def __init__(
        self,
        loss: RainbowLoss,
        optimizer: torch.optim.Optimizer,
        buffer: TensorDictReplayBuffer,
        config: RainbowConfig,
        *,
        seed: int,
        exploration: EGreedyModule | None = None,
        on_non_finite: str = "stop",
    ) -> None:
        self.loss, self.optimizer, self.buffer = loss, optimizer, buffer
        self.config = config
        self.exploration = exploration
        self.n_step = NStep(config.gamma, config.num_steps)
        self.generator = torch.Generator().manual_seed(seed)
        self.num_updates = 0
        self.num_episodes = 0
        self.owed_updates = 0.0
        self._target_and_online = target_and_online(loss)
        self.update = Update(
            loss,
            optimizer,
            config.max_grad_norm,
            diagnostics=["q_mean", "clipped_mass"],
            noted=["priority_mean", "priority_max"],
            on_non_finite=on_non_finite,
        )
        self.updates = [self.update]
        self._anneal()

    def learn(self, batch: TensorDictBase) -> None:
        """Store a batch ``[W, T]``, and once the buffer is warm make updates.

        Raises:
            NonFiniteUpdateError: If something in an update is not finite; it has changed
                nothing, the priorities included.
        """
        self.store(batch)
        if len(self.buffer) < self.config.warmup_steps:
            return
        owed, self.owed_updates = divmod(self.owed_updates, 1.0)
        for number in range(self.config.updates_per_batch + int(owed)):
            self.step(draw_minibatch(self.buffer), diagnose=number == 0)

    def store(self, batch: TensorDictBase) -> None:
        """Put a batch ``[W, T]`` into the buffer; epsilon decays by ended episode."""
        self.buffer.extend(self.n_step(batch))
        self.num_episodes += int(batch["next", keys.DONE].sum())
        self._anneal()

    def step(self, minibatch: TensorDictBase, *, diagnose: bool = False) -> TensorDict:
        """One update, whose numbers are in the means of ``update``.

        Args:
            minibatch: Drawn from the buffer.
            diagnose: As of :class:`~gdrl_torchrl.agents.update.Update`.

        Returns:
            The losses, as of :class:`~gdrl_torchrl.agents.update.Update`.

        Raises:
            NonFiniteUpdateError: As of :meth:`learn`.
        """
        resample_noise(self.loss)
        losses = self.update(minibatch, diagnose=diagnose)
        if self.update.skipped:
            return losses
        torch._foreach_lerp_(*self._target_and_online, self.config.target_tau)
        note_errors(self.buffer, minibatch)
        if diagnose:
            error = minibatch[self.loss.tensor_keys.priority]
            self.update.means.add(
                [("priority_mean", error.mean()), ("priority_max", error.max())]
            )
        self.num_updates += 1
        self._anneal()
        return losses

    def share(
        self, transitions: TensorDictBase, share: float, *, with_updates: bool = False
    ) -> int:
        """Take a share of whole episodes ``[T]`` of other policies into the buffer.

        Args:
            transitions: The episodes.
            share: The share.
            with_updates: Whether the next batch has as many updates more as those
                transitions would have had as the agent's own.

        Returns:
            How many entered.
        """
        count = share_experience(
            self.buffer, transitions, self.n_step, share, self.generator
        )
        if with_updates:
            per_step = self.config.updates_per_batch / self.config.frames_per_batch
            self.owed_updates += per_step * count
        return count

    def _anneal(self) -> None:
        config = self.config
        sampler: Any = self.buffer.sampler
        beta = config.replay_beta + config.replay_beta_increment * self.num_updates
        sampler.beta = min(1.0, beta)
        if self.exploration is not None:
            epsilon = config.epsilon_start * config.epsilon_decay**self.num_episodes
            current: Any = self.exploration.eps
            current.fill_(max(config.epsilon_end, epsilon))

    def state_dict(self) -> dict[str, Any]:
        """Buffer, counters and generator."""
        return {
            "buffer": buffer_state(self.buffer),
            "num_updates": self.num_updates,
            "num_episodes": self.num_episodes,
            "owed_updates": self.owed_updates,
            "num_skipped": self.update.num_skipped,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        load_buffer_state(self.buffer, state_dict["buffer"])
        self.num_updates = state_dict["num_updates"]
        self.num_episodes = state_dict["num_episodes"]
        self.owed_updates = state_dict["owed_updates"]
        self.update.num_skipped = state_dict["num_skipped"]
        self.generator.set_state(state_dict["generator"])
        self._anneal()
