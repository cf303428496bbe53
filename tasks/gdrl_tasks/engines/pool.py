"""All worlds of a simulation in shards, which threads step side by side."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np

from gdrl_tasks.engines.shard import Shard
from gdrl_tasks.spec import WorldArrays, WorldIndex
from gdrl_tasks.task import NavigationTask

_WORLDS_PER_THREAD = 8
"""With fewer worlds a second thread costs more time than it saves."""
_WORLDS_PER_SHARD = 20
"""The same for threads that each run a loop over substeps and take turns in Python."""


class ShardPool:
    """Shards of neighbouring worlds and the threads that step them.

    Worlds are numbered as in the whole simulation, ascending.

    Args:
        task: The task.
        model: The model that the engines step.
        arrays: The task's arrays of all worlds.
        qpos: Positions of all worlds, ``[W, nq]``, written.
        qvel: Velocities of all worlds, ``[W, nv]``, written.
        num_threads: Threads at most, >= 1.
    """

    def __init__(
        self,
        task: NavigationTask,
        model: mujoco.MjModel,
        arrays: WorldArrays,
        qpos: np.ndarray,
        qvel: np.ndarray,
        num_threads: int,
    ) -> None:
        enough = _WORLDS_PER_SHARD if task.has_substep_forces else _WORLDS_PER_THREAD
        count = max(1, min(num_threads, len(qpos) // enough))
        engine_threads = 1
        if not task.has_substep_forces:
            count, engine_threads = 1, count
        self._bounds = np.linspace(0, len(qpos), count + 1).astype(np.int64)
        self._shards = []
        for low, high in zip(self._bounds[:-1], self._bounds[1:], strict=True):
            views = {name: value[low:high] for name, value in arrays.items()}
            shard = Shard(
                task, model, views, qpos[low:high], qvel[low:high], engine_threads
            )
            self._shards.append(shard)
        # The calling thread steps the first shard.
        self._threads = (
            ThreadPoolExecutor(count - 1, "gdrl-simulation") if count > 1 else None
        )

    @property
    def states(self) -> list[np.ndarray]:
        """Live states of the engines, ``[W_i, S]``, one array for each shard."""
        return [shard.batch.state for shard in self._shards]

    def set_states(self, states: np.ndarray) -> None:
        """Set the states of the engines of all worlds, ``[W, S]``."""
        for shard, low in zip(self._shards, self._bounds[:-1], strict=True):
            rows = shard.batch.state
            # Counters of warnings are not part of the state, so they start anew.
            shard.reset(np.arange(len(rows)))
            rows[...] = states[low : low + len(rows)]
            shard.write_model(np.arange(len(rows)))

    def reset(self, ids: WorldIndex) -> None:
        """Reset the engines of worlds ``[K]``."""
        for shard, own in zip(self._shards, self._split(ids), strict=True):
            shard.reset(own)

    def write_model(self, ids: WorldIndex) -> None:
        """Write the fields of the model that differ by world, of worlds ``[K]``."""
        for shard, own in zip(self._shards, self._split(ids), strict=True):
            shard.write_model(own)

    def advance(self, ids: WorldIndex) -> np.ndarray:
        """Step worlds ``[K]`` through a control interval.

        Returns:
            Mask of those that diverged, ``[K]``.
        """
        parts = self._split(ids)
        waiting = [
            self._threads.submit(shard.advance, own)
            for shard, own in zip(self._shards[1:], parts[1:], strict=True)
            if self._threads is not None
        ]
        diverged = [self._shards[0].advance(parts[0])]
        diverged += [future.result() for future in waiting]
        return diverged[0] if len(diverged) == 1 else np.concatenate(diverged)

    def close(self) -> None:
        """Stop the threads."""
        if self._threads is not None:
            self._threads.shutdown()
            self._threads = None

    def _split(self, ids: WorldIndex) -> list[WorldIndex]:
        """Worlds among ``ids`` of each shard, numbered within the shard."""
        if len(self._shards) == 1:
            return [ids]
        cuts = np.searchsorted(ids, self._bounds)
        return [
            ids[begin:end] - low
            for begin, end, low in zip(cuts[:-1], cuts[1:], self._bounds, strict=False)
        ]
