"""Records of worlds that diverged, and the memory of the states before that."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np


@dataclasses.dataclass(frozen=True)
class DivergedWorld:
    """A world whose state after a step is invalid."""

    world: int
    """Its number in the simulation."""
    action: np.ndarray
    """Action of that step, ``[A]`` or ``[]``."""
    before: dict[str, np.ndarray]
    """The task's arrays, ``qpos``, ``qvel`` and ``engine`` before that step, ``[1, ...]``
    each."""
    qpos: np.ndarray
    """Generalised positions after that step, ``[nq]``."""
    qvel: np.ndarray
    """Generalised velocities after that step, ``[nv]``."""

    @property
    def episode_seed(self) -> int:
        """Seed of the episode."""
        return int(self.before["episode_seed"][0])

    @property
    def steps(self) -> int:
        """Control steps that the episode had made before that step."""
        return int(self.before["steps"][0])


class StateMemory:
    """The state of all worlds before their last step.

    Args:
        named: Arrays ``[W, ...]`` by name.
        engines: States of the engines, ``[W_i, S]``, each of neighbouring worlds.
    """

    def __init__(
        self, named: Mapping[str, np.ndarray], engines: Sequence[np.ndarray]
    ) -> None:
        self._sources = [*named.values(), *engines]
        self._copies = [source.copy() for source in self._sources]
        self._names = list(named)

    def note(self) -> None:
        """Copy the state."""
        for copy, source in zip(self._copies, self._sources, strict=True):
            np.copyto(copy, source)

    def of(self, world: int) -> dict[str, np.ndarray]:
        """Rows of a world in the copy, ``[1, ...]`` each."""
        count = len(self._names)
        rows = {
            name: copy[world : world + 1].copy()
            for name, copy in zip(self._names, self._copies, strict=False)
        }
        engine = np.concatenate(self._copies[count:])
        return rows | {"engine": engine[world : world + 1]}
