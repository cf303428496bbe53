"""What a task and its engines agree on: shapes and times, arrays of worlds, episodes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np

from gdrl_tasks.kernels import all_choices

WorldArrays = dict[str, np.ndarray]
"""Arrays of all worlds by name, each ``[W, ...]``."""

WorldIndex = np.ndarray
"""Indices of the worlds that a call acts on, ``[K]``, int64, ascending."""

NOT_BEGUN = -1
"""Outcome of a world before its first episode."""


@dataclasses.dataclass(frozen=True)
class TaskSpec:
    """Shapes, bounds and times of a task.

    ``observation`` maps names to (size, minimum, maximum); the flat observation is
    their concatenation in that order, and begins with ``goal_distance`` and
    ``goal_bearing``.
    """

    observation: Mapping[str, tuple[int, float, float]]
    action_size: int
    """Number of continuous commands in [-1, 1], or of discrete actions."""
    is_discrete: bool
    control_interval_s: float
    substep_s: float
    step_limit: int
    running_reward_limit: float = 0.0
    """Largest absolute reward of a step that does not end the episode."""

    @property
    def reward_range(self) -> tuple[float, float]:
        """Least and largest reward of any step; the end of an episode gives -1 or 1."""
        largest = max(1.0, self.running_reward_limit)
        return -largest, largest

    def return_range(self, gamma: float) -> tuple[float, float]:
        """Least and largest discounted return of an episode.

        Args:
            gamma: Discount in [0, 1].

        Raises:
            ValueError: If ``gamma`` is out of range.

        Examples:
            >>> spec = TaskSpec({}, 1, False, 0.1, 0.1, step_limit=9)
            >>> spec.return_range(0.99)
            (-1.0, 1.0)
        """
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"gamma={gamma} must be in [0, 1]")
        # With rewards of +-limit until the last step, which gives +-1, the return is
        # monotonic in the episode's length, so the shortest or the longest has the most.
        steps = self.step_limit - 1
        weight = sum(gamma**step for step in range(steps))
        last = max(1.0, self.running_reward_limit)
        longest = self.running_reward_limit * weight + last * gamma**steps
        # A truncated episode has the value of what would have followed.
        if gamma < 1.0:
            longest = max(longest, self.running_reward_limit / (1.0 - gamma))
        largest = max(1.0, longest)
        return -largest, largest

    @functools.cached_property
    def num_substeps(self) -> int:
        """Physics substeps in a control interval."""
        return round(self.control_interval_s / self.substep_s)

    @functools.cached_property
    def columns(self) -> dict[str, slice]:
        """Slices of the named observations in the flat one."""
        ends = np.cumsum([size for size, _, _ in self.observation.values()]).tolist()
        starts = [0, *ends[:-1]]
        return dict(zip(self.observation, map(slice, starts, ends), strict=True))

    @functools.cached_property
    def observation_size(self) -> int:
        """Length ``D`` of the flat observation."""
        return sum(size for size, _, _ in self.observation.values())

    @functools.cached_property
    def observation_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the flat observation, ``[D]`` each."""
        low = [np.full(size, low) for size, low, _ in self.observation.values()]
        high = [np.full(size, high) for size, _, high in self.observation.values()]
        return np.concatenate(low), np.concatenate(high)

    def checked_action(self, action: Any, count: int) -> np.ndarray:
        """Actions of ``count`` worlds as an array; they need not be finite.

        Raises:
            ValueError: If they are not numbers, have another shape than ``[K, A]`` (or
                ``[K]`` if discrete), or a discrete one is not one of the choices.
        """
        shape = (count,) if self.is_discrete else (count, self.action_size)
        action = np.asarray(action)
        if action.dtype.kind not in "biuf":
            raise ValueError(f"action of type {action.dtype} must be real numbers")
        if action.shape != shape:
            raise ValueError(f"action of shape {action.shape} must have shape {shape}")
        is_int64 = self.is_discrete and action.dtype == np.int64
        if is_int64 and all_choices(action, self.action_size):
            return action
        if self.is_discrete and action.dtype.kind == "f":
            fractional = np.isfinite(action) & (action % 1 != 0)
            if fractional.any():
                raise ValueError(
                    f"action={action[fractional][0]} must be an integer in "
                    f"[0, {self.action_size})"
                )
        if self.is_discrete:
            # Written so that NaN passes; its world then diverges.
            wrong = (action < 0) | (action >= self.action_size)
            if wrong.any():
                raise ValueError(
                    f"action={action[wrong][0]} must be an integer in "
                    f"[0, {self.action_size})"
                )
        return action


@dataclasses.dataclass(frozen=True)
class Episode:
    """One drawn episode: the initial state of the engine and of the task's arrays."""

    qpos: np.ndarray
    qvel: np.ndarray
    arrays: Mapping[str, Any]
    """Initial rows of the task's arrays, by name; ``goal`` is always among them.

    ``shortest_path`` is the length of the way to the goal, if that is no straight line.
    """
