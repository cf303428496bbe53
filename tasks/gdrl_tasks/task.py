"""The base of tasks: a model, per-world arrays and pure steps over them.

A :class:`NavigationTask` is written once and runs on two engines: many worlds on
``mujoco.batch`` (:mod:`gdrl_tasks.engines.batch`) and one world in dm_control
(:mod:`gdrl_tasks.engines.dm_env`). Both keep the same arrays, with a leading world axis
``W``, and call the same methods.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import mujoco
import numpy as np

from gdrl_tasks.kernels import (
    LARGEST_STATE,
    all_choices,
    all_sane,
    clip_rows,
    finish,
    free_body_pose,
    observe_goal,
)
from gdrl_tasks.navigation import Outcome

WorldArrays = dict[str, np.ndarray]
"""Arrays of all worlds by name, each ``[W, ...]``."""

NOT_BEGUN = -1
"""Outcome of a world before its first episode."""

_WRITTEN = (
    "goal",
    "position",
    "distance",
    "path_length",
    "episode_return",
    "steps",
    "outcome",
)
"""Arrays that :func:`~gdrl_tasks.kernels.finish` reads and writes, in its order."""

WorldIndex = np.ndarray
"""Indices of the worlds that a call acts on, ``[K]``, int64, ascending."""


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


class NavigationTask(abc.ABC):
    """A vehicle that must reach a goal: outcome, reward and metrics.

    Subclasses give the model, the vehicle's pose, the forces on it and what it observes.
    All methods work on rows ``ids`` of arrays that hold every world.
    """

    name: ClassVar[str]
    spec: TaskSpec
    has_substep_forces: ClassVar[bool] = False
    """Whether :meth:`apply_forces` must run before every physics substep."""
    model_fields: ClassVar[tuple[str, ...]] = ()
    """Fields of the model that differ by world, see :meth:`write_model_fields`."""

    goal_tolerance_m: float
    progress_weight: float
    """Reward per metre of progress towards the goal."""
    truncates_at_limit: bool
    """Whether the step limit truncates an episode (no penalty) instead of ending it."""

    @abc.abstractmethod
    def xml(self) -> str:
        """The model, with all that is drawn of it."""

    def engine_model(self) -> mujoco.MjModel:
        """The model that batches step and that is never drawn: here the whole one.

        Tasks whose scenery costs the engine time may leave it out, see
        :func:`~gdrl_tasks.engines.scenery.without_scenery`.
        """
        return mujoco.MjModel.from_xml_string(self.xml())

    @abc.abstractmethod
    def draw_episode(self, seed: int) -> Episode:
        """Draw the episode that belongs to a seed; the same for every world."""

    @abc.abstractmethod
    def extra_arrays(self, num_worlds: int) -> WorldArrays:
        """The task's own arrays ``[W, ...]``, beside those of :meth:`allocate`.

        If the model has actuators, ``control`` ``[W, nu]`` holds their controls.
        """

    @abc.abstractmethod
    def set_action(self, arrays: WorldArrays, ids: WorldIndex, action: Any) -> None:
        """Store the commands that belong to actions ``[K, A]`` or ``[K]``."""

    def planar_pose(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions in metres ``[K, 2]`` and headings in radians ``[K]``.

        By default those of a vehicle whose free joint is the model's first joint.
        """
        return free_body_pose(qpos)

    @abc.abstractmethod
    def observe_extra(
        self, arrays: WorldArrays, ids: WorldIndex, qpos: np.ndarray, qvel: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Observations beside goal distance and bearing, ``[K]`` or ``[K, size]``."""

    def bind_forces(
        self,
        arrays: WorldArrays,
        qpos: np.ndarray,
        qvel: np.ndarray,
        time_s: np.ndarray,
        xfrc_applied: np.ndarray,
    ) -> Callable[[WorldIndex], None]:
        """:meth:`apply_forces` as a function of the worlds alone, ``[K]``.

        The arrays keep their memory, so anything that depends on them is prepared once.
        """
        return lambda ids: self.apply_forces(arrays, ids, qpos, qvel, time_s, xfrc_applied)

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

    def write_model_fields(
        self, fields: Mapping[str, np.ndarray], arrays: WorldArrays, ids: WorldIndex
    ) -> None:
        """Write the fields of the model that an episode changes, as the episode begins.

        Args:
            fields: Live arrays of :attr:`model_fields` for all worlds, ``[W, ...]``.
            arrays: Arrays of all worlds.
            ids: The worlds.
        """

    def sense(
        self, arrays: WorldArrays, ids: WorldIndex, position: np.ndarray, yaw: np.ndarray
    ) -> None:
        """Store the readings of sensors with a memory, at the start and after every step.

        Args:
            arrays: Arrays of all worlds; ``steps`` counts the step that was made.
            ids: The worlds.
            position: Their positions, metres, ``[K, 2]``, always finite.
            yaw: Their headings, radians, ``[K]``, always finite.
        """

    def note_scenery(self, physics: Any) -> None:
        """Remember what pictures need of a step; only dm_control's environments call it."""

    def draw_scenery(self, physics: Any, arrays: WorldArrays) -> None:
        """Update what is only drawn, before a frame is rendered."""

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
            "outcome": np.full(n, NOT_BEGUN, dtype=np.int64),
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
        qpos = np.repeat(episode.qpos[None], len(ids), axis=0)
        position, yaw = self.planar_pose(qpos)
        distance = np.hypot(*(arrays["goal"][ids] - position).T)
        arrays["position"][ids] = position
        arrays["distance"][ids] = distance
        shortest = episode.arrays.get("shortest_path", distance)
        arrays["shortest_path"][ids] = np.maximum(shortest - self.goal_tolerance_m, 0.0)
        arrays["episode_seed"][ids] = seed
        self.sense(arrays, ids, position, yaw)

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
            diverged: Mask of those whose state is invalid, ``[K]``.
        """
        if np.count_nonzero(diverged):
            qpos = np.where(diverged[:, None], 0.0, qpos)
        position, yaw = self.planar_pose(qpos)
        reward = finish(
            ids,
            position,
            (
                self.collides(arrays, ids, position, yaw),
                diverged,
                self.capsizes(arrays, ids, qpos),
            ),
            (
                self.goal_tolerance_m,
                self.spec.step_limit,
                self.progress_weight,
                self.truncates_at_limit,
            ),
            tuple([arrays[name] for name in _WRITTEN]),
        )
        self.sense(arrays, ids, position, yaw)
        return reward

    def collides(
        self, arrays: WorldArrays, ids: WorldIndex, position: np.ndarray, yaw: np.ndarray
    ) -> np.ndarray:
        """Mask of worlds in collision, ``[K]``; by default none, as on open water."""
        return np.zeros(len(ids), dtype=bool)

    def capsizes(
        self, arrays: WorldArrays, ids: WorldIndex, qpos: np.ndarray
    ) -> np.ndarray:
        """Mask of worlds whose vehicle is upside down, ``[K]``; by default none is.

        Capsizing ends an episode like a collision, whatever else happened in the same
        control step.

        Args:
            arrays: Arrays of all worlds.
            ids: The worlds.
            qpos: Their generalised positions, ``[K, nq]``; zeros where they diverged.
        """
        return np.zeros(len(ids), dtype=bool)

    def observe(
        self, arrays: WorldArrays, ids: WorldIndex, qpos: np.ndarray, qvel: np.ndarray
    ) -> np.ndarray:
        """Flat observations of worlds ``ids``, ``[K, D]``, always finite."""
        if not all_sane(qpos, qvel):
            qpos, qvel = believable(qpos), believable(qvel)
        position, yaw = self.planar_pose(qpos)
        flat = np.empty((len(ids), self.spec.observation_size))
        observe_goal(ids, position, yaw, arrays["goal"], self.distance_scale_m, flat)
        for name, value in self.observe_extra(arrays, ids, qpos, qvel).items():
            columns = self.spec.columns[name]
            size = columns.stop - columns.start
            flat[:, columns] = value.reshape(len(ids), size)
        clip_rows(flat, *self.spec.observation_bounds)
        return flat

    @property
    @abc.abstractmethod
    def distance_scale_m(self) -> float:
        """Distance that is observed as 1."""


def check_running(ids: WorldIndex, outcome: np.ndarray) -> None:
    """Raise RuntimeError unless an episode is running in all worlds ``ids`` ``[K]``."""
    chosen = outcome[ids]
    if not np.count_nonzero(chosen):
        return
    stopped = ids[chosen != int(Outcome.RUNNING)]
    first = int(outcome[stopped[0]])
    why = "none has begun" if first == NOT_BEGUN else f"it ended: {Outcome(first).name}"
    raise RuntimeError(
        f"no episode is running in {len(stopped)} of {len(ids)} worlds "
        f"(world {stopped[0]}: {why}): reset them, or leave them out of the step"
    )


def believable(state: np.ndarray) -> np.ndarray:
    """A state with bounds on numbers that are not finite or are absurdly large.

    A diverged world is observed too, and its observation must be finite.
    """
    return np.clip(np.nan_to_num(state), -LARGEST_STATE, LARGEST_STATE)
