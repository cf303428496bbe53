"""The base of tasks: a model, per-world arrays and pure steps over them.

A :class:`NavigationTask` is written once and runs on two engines: many worlds on
``mujoco.batch`` (:mod:`gdrl_tasks.engines.batch`) and one world in dm_control
(:mod:`gdrl_tasks.engines.dm_env`). Both keep the same arrays, with a leading world axis
``W``, and call the same methods.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np

from gdrl_tasks.definition import Outcome
from gdrl_tasks.kernels import (
    LARGEST_STATE,
    all_sane,
    clip_rows,
    finish,
    free_body_pose,
    observe_goal,
)
from gdrl_tasks.spec import NOT_BEGUN, Episode, TaskSpec, WorldArrays, WorldIndex

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
        """The model, with all that is drawn of it.

        Batches step it :func:`~gdrl_tasks.engines.scenery.without_scenery`. So what only
        is drawn has no weight, and comes after all that a task addresses by number.
        """

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
