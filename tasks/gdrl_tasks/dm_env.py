"""A task as dm_control's ``control.Environment``: one world, a viewer, cameras."""

from __future__ import annotations

import contextlib
import ctypes
import ctypes.util
import importlib.util
import os
import sys
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

# Mesa's software driver and Triton (which tensordict loads) each carry an LLVM, and the
# process survives only if Triton's comes first. Loading it needs no torch.
_triton = importlib.util.find_spec("triton")
if _triton is not None and _triton.origin is not None and "triton" not in sys.modules:
    with contextlib.suppress(OSError):
        ctypes.CDLL(str(Path(_triton.origin).with_name("_C") / "libtriton.so"))

# Without a display dm_control would still choose GLFW, whose first frame then fails.
if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    if "MUJOCO_GL" not in os.environ and ctypes.util.find_library("EGL"):
        os.environ["MUJOCO_GL"] = "egl"

from dm_control import mujoco
from dm_control.rl import control
from dm_control.suite import base
from dm_env import specs

from gdrl_tasks.kernels import all_sane
from gdrl_tasks.navigation import Outcome
from gdrl_tasks.quiet import quiet_engine
from gdrl_tasks.scenery import cast_fewer_shadows, make_room
from gdrl_tasks.task import NavigationTask

_ONE_WORLD = np.zeros(1, dtype=np.int64)
_RUNNING, _TIMEOUT = int(Outcome.RUNNING), int(Outcome.TIMEOUT)
_SCENE_CALLBACK = 7
"""Place of the scene's callback among the arguments after height and width."""
_YES, _NO = np.ones(1, dtype=bool), np.zeros(1, dtype=bool)


class TaskPhysics(mujoco.Physics):
    """Physics that runs a callback before every substep and survives divergence."""

    before_substep: Callable[[], None] | None = None
    before_render: Callable[[], None] | None = None
    diverged: bool = False

    def step(self, nstep: int = 1) -> None:
        """Advance by substeps; a physics error sets ``diverged`` and is not raised."""
        if self.diverged:
            return
        # Not super().step(): its check of the warnings costs a tenth of a whole step.
        with quiet_engine():
            if self.before_substep is None:
                self._step_with_up_to_date_position_velocity(nstep)
            else:
                for _ in range(nstep):
                    self.before_substep()
                    self._step_with_up_to_date_position_velocity(1)
        # A reset clears the engine's counts.
        self.diverged = any(self._warnings.tolist())

    def render(
        self, height: int = 240, width: int = 320, *args: Any, **kwargs: Any
    ) -> np.ndarray:
        """Render, after the scenery was brought up to date.

        As that of :class:`dm_control.mujoco.Physics`, for pictures of up to 3,840 by
        2,160 pixels.
        """
        make_room(self, height, width)
        if self.before_render is not None:
            self.before_render()
        if len(args) < _SCENE_CALLBACK:
            own = kwargs.get("scene_callback")

            def change(physics: Any, scene: Any) -> None:
                cast_fewer_shadows(scene.ptr)
                if own is not None:
                    own(physics, scene)

            kwargs["scene_callback"] = change
        return super().render(height, width, *args, **kwargs)


class SuiteTask(base.Task):
    """A :class:`NavigationTask` in the form that ``control.Environment`` runs.

    Attributes:
        task: The task itself.
        flat_observation: Whether the environment concatenates the observations.
        arrays: Its arrays, for one world.
        next_episode_seed: Set it to choose the episode of the next reset.
    """

    def __init__(
        self,
        task: NavigationTask,
        random: int | np.random.RandomState | None = None,
        *,
        flat_observation: bool = False,
    ) -> None:
        super().__init__(random=random)
        self.task = task
        self.flat_observation = flat_observation
        self.arrays = task.allocate(1)
        self.next_episode_seed: int | None = None
        self._reward = 0.0

    def initialize_episode(self, physics: TaskPhysics) -> None:
        """Draw an episode and put the vehicle at its start."""
        seed = self.next_episode_seed
        if seed is None:
            seed = int(self.random.randint(2**31 - 1))
        self.next_episode_seed = None
        episode = self.task.draw_episode(seed)
        self.task.begin_episode(self.arrays, _ONE_WORLD, episode, seed)
        physics.diverged = False
        physics.data.qpos[:] = episode.qpos
        physics.data.qvel[:] = episode.qvel
        physics.data.mocap_pos[0, :2] = self.arrays["goal"][0]
        if self.task.model_fields:
            fields = {
                name: getattr(physics.model, name)[None] for name in self.task.model_fields
            }
            self.task.write_model_fields(fields, self.arrays, _ONE_WORLD)
        if self.task.has_substep_forces:
            physics.before_substep = lambda: self._apply_forces(physics)
        physics.before_render = lambda: self.task.draw_scenery(physics, self.arrays)
        # Not super().initialize_episode(): it calls after_step, a step that never was.

    def before_step(self, action: Any, physics: TaskPhysics) -> None:
        """Store the action; a world whose action is not finite diverges."""
        action = np.asarray(action)
        if self.task.spec.is_discrete and action.size == 1:
            action = action.reshape(())
        action = self.task.spec.checked_action(action[None], 1)
        is_number = action.dtype.kind != "f" or np.isfinite(action).all()
        if not is_number or not _is_sane(physics):
            physics.diverged = True
            return
        self.task.set_action(self.arrays, _ONE_WORLD, action)
        if "control" in self.arrays:
            physics.data.ctrl[:] = self.arrays["control"][0]

    def after_step(self, physics: TaskPhysics) -> None:
        """Decide outcome and reward."""
        qpos = physics.data.qpos[None]
        diverged = _YES if physics.diverged or not _is_sane(physics) else _NO
        reward = self.task.finish_step(self.arrays, _ONE_WORLD, qpos, diverged)
        self._reward = float(reward[0])
        self.task.note_scenery(physics)

    def action_spec(self, physics: TaskPhysics) -> specs.Array:
        """Commands in [-1, 1], or a discrete choice."""
        size = self.task.spec.action_size
        if self.task.spec.is_discrete:
            return specs.DiscreteArray(size, name="action")
        return specs.BoundedArray((size,), np.float64, -1.0, 1.0, name="action")

    def observation_spec(self, physics: TaskPhysics) -> OrderedDict[str, specs.Array]:
        """Bounded arrays by name."""
        if self.flat_observation:
            low, high = self.task.spec.observation_bounds
            name = control.FLAT_OBSERVATION_KEY
            spec = specs.BoundedArray(low.shape, np.float64, low, high, name=name)
            return OrderedDict([(name, spec)])
        observation = self.task.spec.observation.items()
        return OrderedDict(
            (name, specs.BoundedArray((size,), np.float64, low, high, name=name))
            for name, (size, low, high) in observation
        )

    def get_observation(self, physics: TaskPhysics) -> OrderedDict[str, np.ndarray]:
        """Named observations."""
        qpos, qvel = physics.data.qpos[None], physics.data.qvel[None]
        flat = self.task.observe(self.arrays, _ONE_WORLD, qpos, qvel)[0]
        columns = self.task.spec.columns.items()
        return OrderedDict((name, flat[where]) for name, where in columns)

    def get_reward(self, physics: TaskPhysics) -> float:
        """Reward of the last control step."""
        return self._reward

    def get_termination(self, physics: TaskPhysics) -> float | None:
        """None to go on; the discount at the end: 1 if truncated, else 0."""
        outcome = self.arrays["outcome"][0]
        if outcome == _RUNNING:
            return None
        return 1.0 if outcome == _TIMEOUT and self.task.truncates_at_limit else 0.0

    @property
    def outcome(self) -> Outcome:
        """Outcome of the episode so far."""
        return Outcome(int(self.arrays["outcome"][0]))

    def _apply_forces(self, physics: TaskPhysics) -> None:
        data = physics.data
        self.task.apply_forces(
            self.arrays,
            _ONE_WORLD,
            data.qpos[None],
            data.qvel[None],
            np.array([data.time]),
            data.xfrc_applied[None],
        )


def _is_sane(physics: TaskPhysics) -> bool:
    return all_sane(physics.data.qpos, physics.data.qvel)


def make_environment(
    task: NavigationTask,
    *,
    random: int | np.random.RandomState | None = None,
    environment_kwargs: Mapping[str, Any] | None = None,
) -> control.Environment:
    """Make the dm_control environment of a task.

    The step limit is the task's own: the environment has no time limit, because
    ``control.Environment`` never asks for the termination of its last allowed step.
    """
    kwargs: dict[str, Any] = {"n_sub_steps": task.spec.num_substeps}
    kwargs |= dict(environment_kwargs or {})
    physics = TaskPhysics.from_xml_string(task.xml())
    suite_task = SuiteTask(
        task, random, flat_observation=kwargs.get("flat_observation", False)
    )
    return control.Environment(physics, suite_task, **kwargs)
