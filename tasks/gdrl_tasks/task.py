"""What a task is: a model, per-world arrays and pure steps over them.

A :class:`NavigationTask` is written once and runs on two engines: many worlds on
``mujoco.batch`` (:mod:`gdrl_tasks.batch`) and one world in dm_control
(:mod:`gdrl_tasks.dm_env`). Both keep the same arrays, with a leading world axis ``W``,
and call the same methods.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from gdrl_tasks.navigation import Outcome, decide_outcome, goal_polar, segment_distance

WorldArrays = dict[str, np.ndarray]
"""Arrays of all worlds by name, each ``[W, ...]``."""

_LARGEST_SEEN = 1e6

WorldIndex = np.ndarray
"""Indices of the worlds that a call acts on, ``[K]``, int64, ascending."""


@dataclasses.dataclass(frozen=True)
class TaskSpec:
    """Shapes, bounds and times of a task.

    ``observation`` maps names to (size, minimum, maximum); the flat observation is
    their concatenation in that order.
    """

    observation: Mapping[str, tuple[int, float, float]]
    action_size: int
    """Number of continuous commands in [-1, 1], or of discrete actions."""
    is_discrete: bool
    control_interval_s: float
    substep_s: float
    step_limit: int
    reward_range: tuple[float, float]

    @property
    def num_substeps(self) -> int:
        """Physics substeps in a control interval."""
        return round(self.control_interval_s / self.substep_s)

    @property
    def observation_size(self) -> int:
        """Length ``D`` of the flat observation."""
        return sum(size for size, _, _ in self.observation.values())

    @property
    def observation_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the flat observation, ``[D]`` each."""
        low = [np.full(size, low) for size, low, _ in self.observation.values()]
        high = [np.full(size, high) for size, _, high in self.observation.values()]
        return np.concatenate(low), np.concatenate(high)

    def checked_action(self, action: Any, count: int) -> np.ndarray:
        """Actions of ``count`` worlds as an array; those not finite are let through.

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
        if self.is_discrete:
            choice = action[np.isfinite(action)]
            wrong = (choice < 0) | (choice >= self.action_size) | (choice % 1 != 0)
            if wrong.any():
                raise ValueError(
                    f"action={choice[wrong][0]} must be an integer in "
                    f"[0, {self.action_size})"
                )
        return action


@dataclasses.dataclass(frozen=True)
class Episode:
    """One drawn episode: the initial state of the engine and of the task's arrays."""

    qpos: np.ndarray
    qvel: np.ndarray
    arrays: Mapping[str, Any]
    """Initial rows of the task's arrays, by name; ``goal`` is always among them."""


class NavigationTask(abc.ABC):
    """A vehicle that must reach a goal: outcome, reward and metrics.

    Subclasses give the model, the vehicle's pose, what acts on it and what it sees.
    All methods work on rows ``ids`` of arrays that hold every world.
    """

    name: ClassVar[str]
    spec: TaskSpec
    has_substep_forces: ClassVar[bool] = False
    """Whether :meth:`apply_forces` must run before every physics substep."""

    goal_tolerance_m: float
    progress_weight: float
    """Reward per metre of progress towards the goal."""
    truncates_at_limit: bool
    """Whether the step limit truncates an episode (no penalty) instead of ending it."""

    @abc.abstractmethod
    def xml(self) -> str:
        """The model that every engine loads."""

    @abc.abstractmethod
    def draw_episode(self, seed: int) -> Episode:
        """Draw the episode that belongs to a seed; the same for every world."""

    @abc.abstractmethod
    def extra_arrays(self, num_worlds: int) -> WorldArrays:
        """The task's own arrays ``[W, ...]``, beside those of :meth:`allocate`."""

    @abc.abstractmethod
    def set_action(self, arrays: WorldArrays, ids: WorldIndex, action: Any) -> None:
        """Store the commands that belong to actions ``[K, A]`` or ``[K]``."""

    @abc.abstractmethod
    def planar_pose(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions in metres ``[K, 2]`` and headings in radians ``[K]``."""

    @abc.abstractmethod
    def observe_extra(
        self, arrays: WorldArrays, ids: WorldIndex, qpos: np.ndarray, qvel: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Observations beside goal distance and bearing, ``[K]`` or ``[K, size]``."""

    def apply_forces(
        self,
        arrays: WorldArrays,
        ids: WorldIndex,
        qpos: np.ndarray,
        qvel: np.ndarray,
        time_s: np.ndarray,
        xfrc_applied: np.ndarray,
    ) -> None:
        """Write the forces of the coming substep; arrays hold every world."""

    def draw_scenery(self, physics: Any, arrays: WorldArrays) -> None:
        """Bring what only the eye sees up to date before a frame is rendered."""

    def allocate(self, num_worlds: int) -> WorldArrays:
        """Arrays for all worlds, before any episode has begun."""
        n = num_worlds
        arrays = {
            "goal": np.zeros((n, 2)),
            "position": np.zeros((n, 2)),
            "distance": np.zeros(n),
            "path_length": np.zeros(n),
            "shortest_path": np.zeros(n),
            "episode_return": np.zeros(n),
            "episode_number": np.zeros(n, dtype=np.int64),
            "episode_seed": np.zeros(n, dtype=np.int64),
            "steps": np.zeros(n, dtype=np.int64),
            "outcome": np.zeros(n, dtype=np.int64),
        }
        return arrays | self.extra_arrays(n)

    def begin_episode(
        self, arrays: WorldArrays, ids: WorldIndex, episode: Episode, seed: int
    ) -> None:
        """Set rows ``ids`` of the arrays to the start of an episode."""
        for value in arrays.values():
            value[ids] = 0
        for name, value in episode.arrays.items():
            arrays[name][ids] = value
        position, _ = self.planar_pose(episode.qpos[None])
        distance = np.hypot(*(arrays["goal"][ids] - position).T)
        arrays["position"][ids] = position
        arrays["distance"][ids] = distance
        arrays["shortest_path"][ids] = np.maximum(distance - self.goal_tolerance_m, 0.0)
        arrays["episode_seed"][ids] = seed

    def finish_step(
        self,
        arrays: WorldArrays,
        ids: WorldIndex,
        qpos: np.ndarray,
        diverged: np.ndarray,
    ) -> np.ndarray:
        """Decide outcome and reward after a control step; rewards ``[K]``.

        Args:
            arrays: Arrays of all worlds.
            ids: The worlds that stepped.
            qpos: Their generalised positions, ``[K, nq]``.
            diverged: Mask of those whose state is not to be believed, ``[K]``.
        """
        qpos = np.where(diverged[:, None], 0.0, qpos)
        position, _ = self.planar_pose(qpos)
        before, goal = arrays["position"][ids], arrays["goal"][ids]
        position = np.where(diverged[:, None], before, position)
        distance = np.hypot(*(goal - position).T)
        progress = arrays["distance"][ids] - distance
        steps = arrays["steps"][ids] + 1
        outcome = decide_outcome(
            segment_distance(before, position, goal) <= self.goal_tolerance_m,
            self.collides(arrays, ids, qpos),
            steps >= self.spec.step_limit,
            diverged,
        )
        reward = self.progress_weight * progress
        reward += outcome == Outcome.SUCCESS
        reward -= (outcome == Outcome.COLLISION) | (outcome == Outcome.DIVERGED)
        if not self.truncates_at_limit:
            reward -= outcome == Outcome.TIMEOUT
        arrays["path_length"][ids] += np.hypot(*(position - before).T)
        arrays["position"][ids] = position
        arrays["distance"][ids] = distance
        arrays["steps"][ids] = steps
        arrays["outcome"][ids] = outcome
        arrays["episode_return"][ids] += reward
        return reward

    def collides(
        self, arrays: WorldArrays, ids: WorldIndex, qpos: np.ndarray
    ) -> np.ndarray:
        """Mask of worlds in collision, ``[K]``; open water has none."""
        return np.zeros(len(ids), dtype=bool)

    def observe(
        self, arrays: WorldArrays, ids: WorldIndex, qpos: np.ndarray, qvel: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Named observations of worlds ``ids``, each ``[K, size]``, always finite."""
        # A diverged world is observed too: its numbers need only be finite.
        qpos, qvel = (
            np.clip(np.nan_to_num(state), -_LARGEST_SEEN, _LARGEST_SEEN)
            for state in (qpos, qvel)
        )
        position, yaw = self.planar_pose(qpos)
        distance, bearing = goal_polar(position, yaw, arrays["goal"][ids])
        values = {
            "goal_distance": distance / self.distance_scale_m,
            "goal_bearing": bearing / np.pi,
        }
        values |= self.observe_extra(arrays, ids, qpos, qvel)
        named = {}
        for name, (size, low, high) in self.spec.observation.items():
            named[name] = np.clip(values[name].reshape(len(ids), size), low, high)
        return named

    @property
    @abc.abstractmethod
    def distance_scale_m(self) -> float:
        """Distance that is observed as 1."""
