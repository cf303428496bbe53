"""Saving and restoring everything that a run's future depends on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointRotation,
    StateDictCheckpointAdapter,
)

from gdrl_torchrl.envs.navigation import NavigationEnv
from gdrl_torchrl.training.build import Training


class TrainingState:
    """All state of a :class:`Training` as one ``state_dict``.

    Networks, optimiser, genetic hook, simulator, replay or order of minibatches,
    collector counters and the global torch generator. A dm_control environment has no
    state to restore: a run on that backend resumes with new episodes.

    Args:
        training: The objects.
        counters: A further part with ``state_dict`` and ``load_state_dict``.
    """

    def __init__(self, training: Training, counters: Any) -> None:
        self.training = training
        self.counters = counters

    def state_dict(self) -> dict[str, Any]:
        """State as nested dicts of tensors and plain values."""
        training, agent = self.training, self.training.agent
        env = agent.env
        return {
            "actor": dict(agent.actor.state_dict()),
            "loss": None if agent.loss is None else dict(agent.loss.state_dict()),
            "optimizer": agent.optimizer and agent.optimizer.state_dict(),
            "genetic": training.genetic.state_dict(),
            "env": env.get_state() if isinstance(env, NavigationEnv) else None,
            "parts": {name: dict(p.state_dict()) for name, p in agent.parts.items()},
            "counters": self.counters.state_dict(),
            "collected_frames": int(agent.trainer.collected_frames),
            "generator": torch.get_rng_state(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        training, agent = self.training, self.training.agent
        agent.actor.load_state_dict(state_dict["actor"])
        if agent.loss is not None:
            agent.loss.load_state_dict(state_dict["loss"])
        if agent.optimizer is not None:
            agent.optimizer.load_state_dict(state_dict["optimizer"])
        training.genetic.load_state_dict(state_dict["genetic"])
        for name, part in agent.parts.items():
            part.load_state_dict(state_dict["parts"][name])
        self.counters.load_state_dict(state_dict["counters"])
        agent.trainer.collected_frames = state_dict["collected_frames"]
        if state_dict["env"] is not None:
            assert isinstance(agent.env, NavigationEnv)
            agent.env.set_state(state_dict["env"])
        if agent.collector is not None:
            # The environment goes on from its state; the collector reads where that is.
            agent.collector.reset()
        # Last: whatever came before must not have drawn from it.
        torch.set_rng_state(state_dict["generator"].to(torch.uint8))


class Checkpoints:
    """The last few checkpoints of a run, written atomically and without pickle.

    Args:
        folder: Where they are.
        state: What is saved.
        keep: How many are kept.
    """

    def __init__(self, folder: Path, state: TrainingState, *, keep: int = 2) -> None:
        self._checkpoint = Checkpoint().register(
            "training", state, adapter=StateDictCheckpointAdapter("archive")
        )
        self._rotation = CheckpointRotation(folder, keep_last=keep)

    def save(self, step: int) -> Path:
        """Save the state under a number of steps."""
        return self._rotation.save(self._checkpoint, step=step)

    def load_latest(self) -> bool:
        """Restore the newest checkpoint; False if there is none."""
        if self._rotation.latest() is None:
            return False
        self._rotation.load_latest(self._checkpoint)
        return True


def seed_everything(seed: int) -> None:
    """Seed the global generators of torch and NumPy and keep torch to one thread.

    Results of torch may differ between numbers of threads; networks of this size gain
    nothing from more than one.
    """
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 - libraries draw from it
    torch.set_num_threads(1)
