"""One world of a task as dm_control's physics: it can be copied, pickled and rewound."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import mujoco as engine
import numpy as np
from dm_control import mujoco

from gdrl_tasks.engines.quiet import quiet_engine
from gdrl_tasks.engines.scenery import cast_fewer_shadows, make_room
from gdrl_tasks.spec import WorldArrays
from gdrl_tasks.task import NavigationTask

_ONE_WORLD = np.zeros(1, dtype=np.int64)
_SCENE_CALLBACK = 7
"""Place of the scene's callback among arguments of ``render`` after height and width."""
_ENGINE_STATE = int(engine.mjtState.mjSTATE_INTEGRATION)


class TaskPhysics(mujoco.Physics):
    """Physics of one world of a task, with its forces; divergence raises no error.

    It holds all that future steps depend on. A copy, an unpickled physics and one that is
    set to an earlier state go on bit for bit, whether they are stepped directly or by the
    task. A copy with ``share_model=True`` shares what an episode changes in the model,
    such as the obstacles of the indoor task.

    Attributes:
        task: The task.
        arrays: The task's arrays for this world, ``[1, ...]`` each.
        reward: Reward of the last control step.
        diverged: Whether its state is invalid.
    """

    task: NavigationTask
    arrays: WorldArrays
    reward: float = 0.0
    diverged: bool = False
    _apply_forces: Callable[[np.ndarray], None] | None = None

    @classmethod
    def of_task(cls, task: NavigationTask) -> Self:
        """Physics of a task, before any episode has begun."""
        physics = cls.from_xml_string(task.xml())
        physics._hold(task, task.allocate(1))
        return physics

    def _hold(self, task: NavigationTask, arrays: WorldArrays) -> None:
        self.task, self.arrays = task, arrays
        self.reward, self.diverged = 0.0, False
        if task.has_substep_forces:
            self._time_s = np.zeros(1)
            self._apply_forces = task.bind_forces(
                arrays,
                self.data.qpos[None],
                self.data.qvel[None],
                self._time_s,
                self.data.xfrc_applied[None],
            )

    def _reload_from_data(self, data: Any) -> None:
        super()._reload_from_data(data)
        if hasattr(self, "task"):
            self._hold(self.task, self.arrays)

    def step(self, nstep: int = 1) -> None:
        """Advance by substeps; a physics error sets ``diverged`` and is not raised."""
        if self.diverged:
            return
        # Not super().step(), whose check of the warnings takes a tenth of a whole step.
        with quiet_engine():
            if self._apply_forces is None:
                self._advance(nstep)
            else:
                for _ in range(nstep):
                    self._time_s[0] = self.data.time
                    self._apply_forces(_ONE_WORLD)
                    self._advance(1)
        # A reset sets the engine's counts to zero.
        self.diverged = any(self._warnings.tolist())

    def _advance(self, nstep: int) -> None:
        if self.legacy_step:
            self._step_with_up_to_date_position_velocity(nstep)
        else:
            engine.mj_step(self.model.ptr, self.data.ptr, nstep)

    def reset(self, keyframe_id: int | None = None) -> None:
        """Put the engine at its initial state; the task's arrays do not change."""
        self.diverged = False
        super().reset(keyframe_id)

    def after_reset(self) -> None:
        """Compute what follows from the state, at the end of a reset."""
        # Without actuation, so the actuators' velocities remain zero.
        super().after_reset()
        self._derive()

    def _derive(self) -> None:
        """Compute what a step needs at its start, as the step before does at its end."""
        if not self.diverged:
            with quiet_engine():
                engine.mj_step1(self.model.ptr, self.data.ptr)

    def begin_episode(self, seed: int) -> None:
        """Draw an episode and put the vehicle at its start, within a reset."""
        episode = self.task.draw_episode(seed)
        self.task.begin_episode(self.arrays, _ONE_WORLD, episode, seed)
        self.reward = 0.0
        self.data.qpos[:] = episode.qpos
        self.data.qvel[:] = episode.qvel
        self.data.mocap_pos[0, :2] = self.arrays["goal"][0]
        self._write_model_fields()

    def _write_model_fields(self) -> None:
        names = self.task.model_fields
        if names:
            fields = {name: getattr(self.model, name)[None] for name in names}
            self.task.write_model_fields(fields, self.arrays, _ONE_WORLD)

    def get_state(self, sig: int | None = None) -> np.ndarray:
        """All that future steps depend on, as one vector of floats.

        It holds the state of MuJoCo's integration (time, positions, velocities,
        controls, applied forces, ...), the reward, whether the world has diverged, and
        the task's arrays (sea, thrusters, obstacles, scan, goal, steps, outcome, ...) in
        the order of :attr:`arrays`. An integer takes two places, for its upper and its
        lower 32 bits. The state fits only the same task with the same options.

        Args:
            sig: If given, MuJoCo's state of that signature alone, without the task.
        """
        if sig is not None:
            return super().get_state(sig)
        own = [self.reward, float(self.diverged)]
        task = [_as_floats(value) for value in self.arrays.values()]
        return np.concatenate([super().get_state(_ENGINE_STATE), own, *task])

    def state(self) -> np.ndarray:
        """The same as :meth:`get_state`."""
        return self.get_state()

    def set_state(self, physics_state: np.ndarray, sig: int | None = None) -> None:
        """Return to a state of :meth:`get_state`.

        Args:
            physics_state: The state, of this physics or of another of the same task.
            sig: If given, it is MuJoCo's state of that signature alone.

        Raises:
            ValueError: If it has another shape.
        """
        if sig is not None:
            super().set_state(physics_state, sig)
            return
        size = engine.mj_stateSize(self.model.ptr, _ENGINE_STATE)
        sizes = [_num_floats(value) for value in self.arrays.values()]
        expected = (size + 2 + sum(sizes),)
        if np.shape(physics_state) != expected:
            raise ValueError(
                f"physics_state of shape {np.shape(physics_state)} must have shape "
                f"{expected}: take it from get_state() of the same task and options"
            )
        super().set_state(physics_state[:size], _ENGINE_STATE)
        self.reward = float(physics_state[size])
        self.diverged = bool(physics_state[size + 1])
        parts = np.split(physics_state[size + 2 :], np.cumsum(sizes)[:-1])
        for value, part in zip(self.arrays.values(), parts, strict=True):
            _write_floats(value, part)
        self._write_model_fields()
        self._warnings[:] = 0
        self._derive()

    def copy(self, share_model: bool = False) -> Self:
        """An independent copy; it shares nothing except, if asked for, the model."""
        other = super().copy(share_model=share_model)
        other.legacy_step = self.legacy_step
        arrays = {name: value.copy() for name, value in self.arrays.items()}
        other._restore(self.task, arrays, self.get_state())
        return other

    def __getstate__(self) -> tuple[Any, ...]:
        own = (self.task, self.arrays, self.get_state())
        return (super().__getstate__(), self.legacy_step, *own)

    def __setstate__(self, pickled: tuple[Any, ...]) -> None:
        data, self.legacy_step, *own = pickled
        super().__setstate__(data)
        self._restore(*own)

    def _restore(
        self, task: NavigationTask, arrays: WorldArrays, state: np.ndarray
    ) -> None:
        # Making a physics from data has changed some of the data: restore it.
        self._hold(task, arrays)
        self.set_state(state)

    def before_render(self) -> None:
        """Update the scenery; set to None, the scenery is left as drawn before."""
        self.task.draw_scenery(self, self.arrays)

    def render(
        self, height: int = 240, width: int = 320, *args: Any, **kwargs: Any
    ) -> np.ndarray:
        """Update the scenery and render; the state does not change.

        Arguments as for :class:`dm_control.mujoco.Physics`, for pictures of up to 3,840
        by 2,160 pixels.
        """
        make_room(self, height, width)
        # The scenery moves bodies by hand, and their places belong to the state.
        moved = self.data.mocap_pos.copy(), self.data.mocap_quat.copy()
        if self.before_render is not None:
            self.before_render()
        self.data.mocap_pos[:], self.data.mocap_quat[:] = moved
        if len(args) < _SCENE_CALLBACK:
            own = kwargs.get("scene_callback")

            def change(physics: Any, scene: Any) -> None:
                cast_fewer_shadows(scene.ptr)
                if own is not None:
                    own(physics, scene)

            kwargs["scene_callback"] = change
        return super().render(height, width, *args, **kwargs)


def _num_floats(values: np.ndarray) -> int:
    return values.size if values.dtype.kind == "f" else 2 * values.size


def _as_floats(values: np.ndarray) -> np.ndarray:
    """An array as floats without any loss, ``[N]``."""
    if values.dtype.kind == "f":
        return values.ravel()
    whole = values.ravel().astype(np.int64)
    return np.concatenate([whole >> 32, whole & 0xFFFFFFFF]).astype(np.float64)


def _write_floats(values: np.ndarray, floats: np.ndarray) -> None:
    if values.dtype.kind != "f":
        upper, lower = floats.astype(np.int64).reshape(2, -1)
        floats = (upper << 32) | lower
    values[...] = floats.reshape(values.shape)
