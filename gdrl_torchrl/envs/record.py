"""Entries of an environment about its worlds: at one step, or at many at once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from gdrl_tasks import BatchSimulation, NavigationTask, Outcome
from gdrl_torchrl import keys

RECORDED = (
    "outcome",
    "episode_number",
    "episode_seed",
    "steps",
    "episode_return",
    "path_length",
    "shortest_path",
)
"""Arrays of a simulation that entries are made from."""


class StepRecord:
    """Record of all worlds over the steps of a batch, noted one step after another.

    Args:
        simulation: The worlds.
        num_steps: Steps ``T``.

    Examples:
        >>> from gdrl_tasks import simulate
        >>> simulation = simulate("water", num_worlds=2)
        >>> record = StepRecord(simulation, num_steps=1)
        >>> record.note(0, simulation.reset())
        >>> record.tensordict()["observation"].shape
        torch.Size([2, 1, 3])
    """

    def __init__(self, simulation: BatchSimulation, num_steps: int) -> None:
        self.simulation = simulation
        shape = (simulation.num_worlds, num_steps)
        size = simulation.task.spec.observation_size
        self._observation = np.empty((*shape, size), dtype=np.float32)
        arrays = simulation.arrays
        self._recorded = {name: np.empty(shape, arrays[name].dtype) for name in RECORDED}

    def note(self, step: int, observation: np.ndarray) -> None:
        """Note the state of all worlds at a step, and what they observe ``[W, D]``."""
        self._observation[:, step] = observation
        for name, values in self._recorded.items():
            values[:, step] = self.simulation.arrays[name]

    def tensordict(self) -> TensorDict:
        """All entries ``[W, T]``."""
        return make_entries(self.simulation.task, self._observation, self._recorded)


def make_entries(
    task: NavigationTask, observation: np.ndarray, arrays: dict[str, np.ndarray]
) -> TensorDict:
    """Entries of an environment but its reward, from observations and arrays.

    Args:
        task: The task.
        observation: ``[..., D]``, float32; shares its memory with what is returned.
        arrays: Arrays of a simulation, or copies at several steps, ``[...]``.

    Returns:
        A tensordict ``[...]``.
    """
    recorded = {name: arrays[name][..., None] for name in RECORDED}
    outcome, steps = recorded["outcome"], recorded["steps"]
    # Comparing an array with a member of an enumeration is slow, so use plain numbers.
    ended = outcome != int(Outcome.RUNNING)
    truncated = (outcome == int(Outcome.TIMEOUT)) & task.truncates_at_limit
    out = {
        keys.OBSERVATION: observation,
        keys.SUCCESS: outcome == int(Outcome.SUCCESS),
        keys.OUTCOME: outcome.copy(),
        keys.EPISODE_NUMBER: recorded["episode_number"].copy(),
        keys.EPISODE_SEED: recorded["episode_seed"].copy(),
        keys.EPISODE_STEPS: steps.copy(),
        keys.TIME_LEFT: (1.0 - steps / task.spec.step_limit).astype(np.float32),
        keys.DONE: ended,
        keys.TERMINATED: ended & ~truncated,
        keys.TRUNCATED: truncated,
    }
    for name in (keys.EPISODE_RETURN, keys.PATH_LENGTH, keys.SHORTEST_PATH):
        out[name] = recorded[name].astype(np.float32)
    entries: dict[str, Any] = {name: torch.from_numpy(x) for name, x in out.items()}
    return TensorDict(entries, batch_size=observation.shape[:-1])
