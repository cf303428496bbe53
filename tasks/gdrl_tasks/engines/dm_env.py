"""A task as dm_control's ``control.Environment``: one world, a viewer, cameras."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np

from gdrl_tasks.engines.opengl import prepare_opengl

prepare_opengl()

from dm_control.rl import control
from dm_control.suite import base
from dm_env import TimeStep, specs

from gdrl_tasks.definition import Outcome
from gdrl_tasks.engines.physics import TaskPhysics
from gdrl_tasks.kernels import all_sane
from gdrl_tasks.spec import NOT_BEGUN, TaskSpec
from gdrl_tasks.task import NavigationTask, check_running

_ONE_WORLD = np.zeros(1, dtype=np.int64)
_RUNNING, _TIMEOUT = int(Outcome.RUNNING), int(Outcome.TIMEOUT)
_YES, _NO = np.ones(1, dtype=bool), np.zeros(1, dtype=bool)


class SuiteTask(base.Task):
    """A :class:`NavigationTask` as a task of ``control.Environment``.

    Its methods act on the physics that they are given, so that a copy of an
    environment's physics can be stepped by the environment's task.

    Args:
        physics: The world of the environment.
        random: Seed or state of the episodes; None takes a different one every time.
        flat_observation: Whether the environment concatenates the observations.

    Attributes:
        task: The :class:`NavigationTask`.
        arrays: The task's arrays for that world.
        next_episode_seed: Set it to choose the episode of the next reset.
    """

    def __init__(
        self,
        physics: TaskPhysics,
        random: int | np.random.RandomState | None = None,
        *,
        flat_observation: bool = False,
    ) -> None:
        super().__init__(random=random)
        self.task = physics.task
        self.arrays = physics.arrays
        self.flat_observation = flat_observation
        self.next_episode_seed: int | None = None

    def initialize_episode(self, physics: TaskPhysics) -> None:
        """Draw an episode and put the vehicle at its start."""
        seed = self.next_episode_seed
        if seed is None:
            seed = int(self.random.randint(2**31 - 1))
        self.next_episode_seed = None
        physics.begin_episode(seed)
        # Not super().initialize_episode(), which calls after_step though no step was made.

    def before_step(self, action: Any, physics: TaskPhysics) -> None:
        """Store the action; a world whose action is not finite diverges.

        Raises:
            RuntimeError: If no episode has begun, or it has ended.
            ValueError: If the action is not one of the task's actions.
        """
        check_running(_ONE_WORLD, physics.arrays["outcome"])
        action = np.asarray(action)
        if self.task.spec.is_discrete and action.size == 1:
            action = action.reshape(())
        action = self.task.spec.checked_action(action[None], 1)
        is_number = action.dtype.kind != "f" or np.isfinite(action).all()
        if not is_number or not _is_sane(physics):
            physics.diverged = True
            return
        self.task.set_action(physics.arrays, _ONE_WORLD, action)
        if "control" in physics.arrays:
            physics.data.ctrl[:] = physics.arrays["control"][0]

    def after_step(self, physics: TaskPhysics) -> None:
        """Decide outcome and reward."""
        qpos = physics.data.qpos[None]
        diverged = _YES if physics.diverged or not _is_sane(physics) else _NO
        reward = self.task.finish_step(physics.arrays, _ONE_WORLD, qpos, diverged)
        physics.reward = float(reward[0])
        self.task.note_scenery(physics)

    def action_spec(self, physics: TaskPhysics) -> specs.Array:
        """Commands in [-1, 1], or a discrete choice."""
        size = self.task.spec.action_size
        if self.task.spec.is_discrete:
            return specs.DiscreteArray(size, name="action")
        low, high = np.full(size, -1.0), np.full(size, 1.0)
        return _bounded(low, high, "action")

    def observation_spec(self, physics: TaskPhysics) -> OrderedDict[str, specs.Array]:
        """Bounded arrays by name."""
        low, high = self.task.spec.observation_bounds
        columns = self.task.spec.columns
        if self.flat_observation:
            columns = {control.FLAT_OBSERVATION_KEY: slice(None)}
        return OrderedDict(
            (name, _bounded(low[where], high[where], name))
            for name, where in columns.items()
        )

    def get_observation(self, physics: TaskPhysics) -> OrderedDict[str, np.ndarray]:
        """Named observations."""
        qpos, qvel = physics.data.qpos[None], physics.data.qvel[None]
        flat = self.task.observe(physics.arrays, _ONE_WORLD, qpos, qvel)[0]
        columns = self.task.spec.columns.items()
        return OrderedDict((name, flat[where]) for name, where in columns)

    def get_reward(self, physics: TaskPhysics) -> float:
        """Reward of the last control step."""
        return physics.reward

    def get_termination(self, physics: TaskPhysics) -> float | None:
        """None to go on; the discount at the end: 1 if truncated, else 0."""
        outcome = physics.arrays["outcome"][0]
        if outcome == _RUNNING:
            return None
        return 1.0 if outcome == _TIMEOUT and self.task.truncates_at_limit else 0.0

    @property
    def outcome(self) -> Outcome:
        """Outcome of the episode so far.

        Raises:
            RuntimeError: If no episode has begun.
        """
        if self.arrays["outcome"][0] == NOT_BEGUN:
            raise RuntimeError("no episode has begun: reset the environment first")
        return Outcome(int(self.arrays["outcome"][0]))


class NavigationEnvironment(control.Environment):
    """A ``control.Environment`` whose episode ends with the outcome of its physics.

    If the physics are set back to a state before the end of an ended episode, that episode
    goes on; ``control.Environment`` would begin a new one.
    """

    def step(self, action: Any) -> TimeStep:
        """Make a control step, or begin an episode where none is running."""
        self._reset_next_step = self.physics.arrays["outcome"][0] != _RUNNING
        return super().step(action)


def _bounded(low: np.ndarray, high: np.ndarray, name: str) -> specs.BoundedArray:
    return specs.BoundedArray(low.shape, np.float64, low, high, name=name)


def _is_sane(physics: TaskPhysics) -> bool:
    return all_sane(physics.data.qpos, physics.data.qvel)


def make_environment(
    task: NavigationTask,
    *,
    random: int | np.random.RandomState | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
) -> control.Environment:
    """Make the dm_control environment of a task.

    The task applies the step limit. The environment has no time limit, because
    ``control.Environment`` never asks for the termination of its last allowed step.

    Args:
        task: The task.
        random: Seed or state of the episodes; None takes a different one every time.
        environment_kwargs: Arguments of ``control.Environment``.

    Raises:
        ValueError: If one of them contradicts the task.
    """
    kwargs = dict(environment_kwargs or {})
    _check_times(task.spec, kwargs)
    kwargs.pop("control_timestep", None)
    kwargs["n_sub_steps"] = task.spec.num_substeps
    physics = TaskPhysics.of_task(task)
    suite_task = SuiteTask(
        physics, random, flat_observation=kwargs.get("flat_observation", False)
    )
    return NavigationEnvironment(physics, suite_task, **kwargs)


def _check_times(spec: TaskSpec, kwargs: Mapping[str, Any]) -> None:
    interval, substep = spec.control_interval_s, spec.substep_s
    times = f"control_interval_s={interval} and substep_s={substep}"
    limit = f"step_limit={spec.step_limit}"
    for name, own, options in (
        ("n_sub_steps", spec.num_substeps, times),
        ("control_timestep", interval, times),
        ("time_limit", math.inf, limit),
    ):
        value = kwargs.get(name)
        if value is not None and value != own:
            raise ValueError(
                f"environment_kwargs {name}={value!r} contradicts the task, which has "
                f"{own}: change its options {options} instead"
            )
