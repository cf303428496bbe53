"""Many worlds of a task on ``mujoco.batch``, stepped on a pool of threads."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from gdrl_tasks.definition import Outcome
from gdrl_tasks.engines.divergence import DivergedWorld, StateMemory
from gdrl_tasks.engines.pool import ShardPool
from gdrl_tasks.engines.quiet import quiet_engine
from gdrl_tasks.engines.scenery import without_scenery
from gdrl_tasks.kernels import are_rows, rows_are_sane
from gdrl_tasks.processors import allowed_processors
from gdrl_tasks.seeds import Stream, episode_seeds, fresh_seed
from gdrl_tasks.spec import WorldIndex
from gdrl_tasks.task import NavigationTask, check_running

_logger = logging.getLogger(__name__)
_RUNNING, _TIMEOUT = int(Outcome.RUNNING), int(Outcome.TIMEOUT)


class StepResult(NamedTuple):
    """Results of one control step, for the ``K`` worlds that stepped."""

    observation: np.ndarray
    """``[K, D]``, float64."""
    reward: np.ndarray
    """``[K]``, float64."""
    terminated: np.ndarray
    """``[K]``, bool."""
    truncated: np.ndarray
    """``[K]``, bool."""
    outcome: np.ndarray
    """:class:`~gdrl_tasks.definition.Outcome` integers ``[K]``."""


class BatchSimulation:
    """``W`` worlds of one task, each with its own episode.

    Worlds that are not named in a call do not change and cost nothing. Results are
    bit-identical for any number of threads.

    Args:
        task: The task.
        num_worlds: Number of worlds ``W``.
        num_threads: Threads of the simulation; 0 takes one per allowed processor.
        seed: Seed of the episodes that :meth:`reset` draws when it is given none; None
            takes a different one every time.

    Attributes:
        arrays: The task's arrays of all worlds, by name (goal, steps, outcome, ...).
        seed: The seed in use, given or not: with it the same episodes are drawn again.
        qpos: Generalised positions of all worlds, ``[W, nq]``; written values are the
            state at the next step.
        qvel: Generalised velocities of all worlds, ``[W, nv]``, likewise.

    Raises:
        ValueError: If ``num_worlds`` < 1, ``num_threads`` < 0 or ``seed`` < 0.

    Examples:
        >>> from gdrl_tasks import simulate
        >>> worlds = simulate("water", num_worlds=2, sea="calm")
        >>> worlds.reset().shape
        (2, 3)
        >>> worlds.step(np.zeros((2, 2))).outcome
        array([0, 0])
    """

    def __init__(
        self,
        task: NavigationTask,
        num_worlds: int,
        *,
        num_threads: int = 0,
        seed: int | None = None,
    ) -> None:
        seed = fresh_seed() if seed is None else seed
        counts = (("num_worlds", num_worlds, 1), ("num_threads", num_threads, 0))
        for name, value, least in (*counts, ("seed", seed, 0)):
            integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
            if not integer or value < least:
                raise ValueError(f"{name}={value!r} must be an integer >= {least}")
        self.task = task
        self.num_worlds = num_worlds
        self.num_threads = num_threads or allowed_processors()
        self.seed = seed
        self.num_episodes_begun = 0
        self.model = without_scenery(task.xml())
        self.arrays = task.allocate(num_worlds)
        self.qpos = np.zeros((num_worlds, self.model.nq))
        self.qvel = np.zeros((num_worlds, self.model.nv))
        self._all = np.arange(num_worlds)
        self._shards = ShardPool(
            task, self.model, self.arrays, self.qpos, self.qvel, self.num_threads
        )
        self._on_divergence: Callable[[DivergedWorld], object] | None = None
        self._memory: StateMemory | None = None

    def reset(
        self, ids: WorldIndex | None = None, seeds: np.ndarray | None = None
    ) -> np.ndarray:
        """Begin new episodes.

        Args:
            ids: The worlds, ``[K]``, or None for all.
            seeds: Episode seeds ``[K]``; None takes the next seeds of the training
                stream.

        Returns:
            First observations, ``[K, D]``.

        Raises:
            ValueError: If ``seeds`` has another length than ``ids`` or a negative one.
        """
        ids = self._checked_ids(ids)
        start = self.num_episodes_begun
        if seeds is None:
            seeds = episode_seeds(Stream.TRAINING, self.seed, start, len(ids))
        seeds = np.asarray(seeds)
        if seeds.shape != ids.shape or (seeds.size and seeds.dtype.kind not in "iu"):
            raise ValueError(
                f"seeds of shape {seeds.shape} and type {seeds.dtype} must be integers "
                f"for the worlds, {ids.shape}"
            )
        seeds = seeds.astype(np.int64)
        if (seeds < 0).any():
            raise ValueError(f"seeds={seeds.min()} must be >= 0")
        self._shards.reset(ids)
        # Members of a population share their episodes, so each is drawn only once.
        for seed in dict.fromkeys(seeds.tolist()):
            rows = ids[seeds == seed]
            episode = self.task.draw_episode(seed)
            self.qpos[rows], self.qvel[rows] = episode.qpos, episode.qvel
            self.task.begin_episode(self.arrays, rows, episode, seed)
        self._shards.write_model(ids)
        self.arrays["episode_number"][ids] = start + np.arange(len(ids))
        self.num_episodes_begun += len(ids)
        return self.observe(ids)

    def step(self, action: np.ndarray, ids: WorldIndex | None = None) -> StepResult:
        """Advance worlds by one control interval.

        Args:
            action: Commands in [-1, 1], ``[K, A]``, or indices of discrete actions,
                ``[K]``. A world whose action is not finite diverges.
            ids: The worlds, ``[K]``, or None for all.

        Returns:
            Results of the step, for those worlds.

        Raises:
            RuntimeError: If no episode is running in one of those worlds: it has ended,
                or none has begun.
            ValueError: If ``action`` has the wrong shape or a discrete action is out
                of range.
        """
        ids = self._checked_ids(ids)
        check_running(ids, self.arrays["outcome"])
        action = self.task.spec.checked_action(action, len(ids))
        healthy = rows_are_sane(ids, self.qpos, self.qvel)
        if action.dtype.kind == "f":
            finite = np.isfinite(action)
            healthy &= finite if action.ndim == 1 else finite.all(axis=1)
        if self._memory is not None:
            self._memory.note()
        # Rows are picked only if some world is not healthy, because picking copies.
        all_healthy = np.count_nonzero(healthy) == len(ids)
        rows = slice(None) if all_healthy else healthy
        self.task.set_action(self.arrays, ids[rows], action[rows])
        diverged = ~healthy
        with quiet_engine():
            diverged[rows] = self._shards.advance(ids[rows])
        qpos = self.qpos[ids]
        reward = self.task.finish_step(self.arrays, ids, qpos, diverged)
        observation = self.task.observe(self.arrays, ids, qpos, self.qvel[ids])
        outcome = self.arrays["outcome"][ids]
        if np.count_nonzero(diverged):
            self._report(ids[diverged], action[diverged])
        terminated = outcome != _RUNNING
        truncated = (outcome == _TIMEOUT) & self.task.truncates_at_limit
        terminated &= ~truncated
        return StepResult(observation, reward, terminated, truncated, outcome)

    def watch(self, on_divergence: Callable[[DivergedWorld], object]) -> None:
        """Call a function with every world that diverges, at most once in an episode.

        From now on one copy of the state before the last step is kept.
        """
        self._on_divergence = on_divergence
        named = self.arrays | {"qpos": self.qpos, "qvel": self.qvel}
        self._memory = StateMemory(named, self._shards.states)

    def observe(self, ids: WorldIndex | None = None) -> np.ndarray:
        """Flat observations of worlds, ``[K, D]``."""
        ids = self._checked_ids(ids)
        return self.task.observe(self.arrays, ids, self.qpos[ids], self.qvel[ids])

    def get_state(self) -> dict[str, np.ndarray]:
        """All that future steps depend on, as a dict of arrays (copies)."""
        state = {f"arrays.{name}": value.copy() for name, value in self.arrays.items()}
        state["qpos"], state["qvel"] = self.qpos.copy(), self.qvel.copy()
        state["engine"] = np.concatenate(self._shards.states)
        state["seed"] = np.array(self.seed)
        state["num_episodes_begun"] = np.array(self.num_episodes_begun)
        return state

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Return to a state of :meth:`get_state`.

        Raises:
            ValueError: If a field is missing, unknown or of another shape.
        """
        own = self.get_state()
        if own.keys() != state.keys():
            raise ValueError(f"fields of the state differ: {own.keys() ^ state.keys()}")
        for name, value in own.items():
            if np.shape(state[name]) != value.shape:
                raise ValueError(
                    f"{name} has shape {np.shape(state[name])}, expected {value.shape}"
                )
        for name in self.arrays:
            self.arrays[name][...] = state[f"arrays.{name}"]
        self.qpos[...], self.qvel[...] = state["qpos"], state["qvel"]
        self._shards.set_states(state["engine"])
        self.seed = int(state["seed"])
        self.num_episodes_begun = int(state["num_episodes_begun"])

    def close(self) -> None:
        """Stop the threads."""
        self._shards.close()

    def _checked_ids(self, ids: Any) -> np.ndarray:
        if ids is None:
            return self._all
        ids = np.asarray(ids)
        if ids.size == 0:
            return np.zeros(0, dtype=np.int64)
        if ids.ndim != 1 or ids.dtype.kind not in "iu":
            raise ValueError(
                f"ids of shape {ids.shape} and type {ids.dtype} must be integers [K]"
            )
        ids = ids.astype(np.int64, copy=False)
        if are_rows(ids, self.num_worlds):
            return ids
        if ids.min() < 0 or ids.max() >= self.num_worlds:
            worst = ids.min() if ids.min() < 0 else ids.max()
            raise ValueError(f"ids={worst} must be in [0, {self.num_worlds})")
        raise ValueError(f"ids={ids.tolist()} must be ascending, each once")

    def _report(self, ids: WorldIndex, action: np.ndarray) -> None:
        for world, command in zip(ids.tolist(), action, strict=True):
            _logger.debug(
                "world %d diverged in episode %d at step %d",
                world,
                self.arrays["episode_seed"][world],
                self.arrays["steps"][world],
            )
            if self._on_divergence is not None and self._memory is not None:
                self._on_divergence(
                    DivergedWorld(
                        world=world,
                        action=np.array(command),
                        before=self._memory.of(world),
                        qpos=self.qpos[world].copy(),
                        qvel=self.qvel[world].copy(),
                    )
                )
