"""Worlds that are stepped together: an engine and a loop over substeps."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch

from gdrl_tasks.kernels import newly_warned, rows_are_sane
from gdrl_tasks.spec import WorldArrays, WorldIndex
from gdrl_tasks.task import NavigationTask

_DIVERGENCE_WARNINGS = np.array(
    [
        int(mujoco.mjtWarning.mjWARN_BADQPOS),
        int(mujoco.mjtWarning.mjWARN_BADQVEL),
        int(mujoco.mjtWarning.mjWARN_BADQACC),
    ]
)


class Shard:
    """Neighbouring worlds with an engine of their own.

    If forces must be computed before every substep, the threads of one engine for all
    worlds would wait for each other twice a substep. With a shard for each thread they
    wait once a control step. Without such forces one shard with all threads is fastest.

    Args:
        task: The task.
        model: Its compiled model.
        arrays: The task's arrays of this shard's worlds (views of the whole).
        qpos: Positions of this shard's worlds (a view of the whole), written.
        qvel: Velocities of this shard's worlds (a view of the whole), written.
        num_threads: Threads of the engine itself.
    """

    def __init__(
        self,
        task: NavigationTask,
        model: mujoco.MjModel,
        arrays: WorldArrays,
        qpos: np.ndarray,
        qvel: np.ndarray,
        num_threads: int = 1,
    ) -> None:
        self.task = task
        self.arrays = arrays
        self.batch = Batch(model, len(qpos), num_threads)
        self._qpos, self._qvel = qpos, qvel
        self._engine_qpos = self.batch.bind("qpos")
        self._engine_qvel = self.batch.bind("qvel")
        if task.has_substep_forces:
            self._apply_forces = task.bind_forces(
                arrays,
                self._engine_qpos,
                self._engine_qvel,
                self.batch.bind("time"),
                self.batch.bind("xfrc_applied"),
            )
        self._control = self.batch.bind("ctrl") if model.nu else None
        self._warnings = np.zeros(len(qpos), dtype=np.int64)
        self._fields = {name: self.batch.expand(name) for name in task.model_fields}

    def reset(self, ids: WorldIndex) -> None:
        """Reset the engine of worlds, numbered within the shard."""
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._warnings[ids] = 0

    def write_model(self, ids: WorldIndex) -> None:
        """Write the fields of the model that differ by world."""
        if self._fields and len(ids):
            self.task.write_model_fields(self._fields, self.arrays, ids)

    def advance(self, ids: WorldIndex) -> np.ndarray:
        """Step worlds, numbered within the shard, through a control interval.

        Returns:
            Mask ``[K]`` of those that diverged: their states are invalid, or the engine
            has warned of them.
        """
        if len(ids) == 0:
            return np.zeros(0, dtype=bool)
        substeps = self.task.spec.num_substeps
        # Without numbers the engine steps all its worlds; numbers it checks at every call.
        which = None if len(ids) == len(self._qpos) else ids
        self._engine_qpos[...], self._engine_qvel[...] = self._qpos, self._qvel
        if self._control is not None:
            self._control[...] = self.arrays["control"]
        if self.task.has_substep_forces:
            for _ in range(substeps):
                self._apply_forces(ids)
                self.batch.step(which)
        else:
            self.batch.step(which, substeps)
        self._qpos[...], self._qvel[...] = self._engine_qpos, self._engine_qvel
        sane = rows_are_sane(ids, self._qpos, self._qvel)
        warnings = self.batch.warning
        return newly_warned(ids, warnings, _DIVERGENCE_WARNINGS, self._warnings) | ~sane
