"""Whole episodes of a population, as transitions."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from gdrl_torchrl import keys


def mark_truncated(following: TensorDictBase, cut: torch.Tensor) -> None:
    """Mark transitions ``[N]`` as truncated where an episode is cut off.

    The next transition is of another episode, and the last observation has a value.
    """
    shape = following[keys.DONE].shape
    for key in (keys.DONE, keys.TRUNCATED):
        flag = following.get(key, torch.zeros(shape, dtype=torch.bool))
        following.set(key, flag | cut.reshape(-1, *[1] * (flag.ndim - 1)))


def ordered_episodes(log: list[TensorDictBase]) -> TensorDictBase:
    """Transitions of all steps as one tensordict, episode after episode."""
    if not log:
        return TensorDict(batch_size=[0])
    whole: Any = TensorDict.cat(log)
    member, episode, time = (whole.get(name) for name in ("member", "episode", "time"))
    span, episodes = int(time.max()) + 1, int(episode.max()) + 1
    order = (member * episodes + episode) * span + time
    return whole.exclude("time")[order.argsort()]


class EpisodeLog:
    """Transitions of episodes, each world's from its first step to its last.

    Args:
        env: The environment of the worlds.
        observation: What the worlds observe before the first step, ``[W, D]``, float32.
    """

    def __init__(self, env: Any, observation: np.ndarray) -> None:
        self._env, self._arrays = env, env.simulation.arrays
        self._first = {name: self._arrays[name].copy() for name in env.recorded}
        self._observed = observation.copy()
        self._steps: list[tuple[Any, ...]] = []

    def note(
        self,
        worlds: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        observation: np.ndarray,
    ) -> None:
        """Note a step of worlds ``[K]``, with its actions and rewards ``[K, ...]``.

        ``observation`` ``[W, D]`` is what all worlds observe after the step.
        """
        after = [self._arrays[name][worlds] for name in self._first]
        self._steps.append((worlds, action, reward, observation[worlds], *after))

    def transitions(self, trials: int, offset: tuple[int, int]) -> TensorDictBase:
        """All transitions ``[N]`` with the environment's entries, world after world.

        World ``w`` played episode ``w % trials`` of member ``w // trials``, both counted
        from ``offset``.
        """
        columns = [np.concatenate(column) for column in zip(*self._steps, strict=True)]
        order = columns[0].argsort(kind="stable")
        world, action, reward, observation, *after = (x[order] for x in columns)
        begins = np.flatnonzero(np.diff(world, prepend=-1))
        began = world[begins]
        previous = np.arange(len(world)) - 1

        def before(first: np.ndarray, later: np.ndarray) -> np.ndarray:
            values = later[previous]
            values[begins] = first[began]
            return values

        named = dict(zip(self._first, after, strict=True))
        earlier = {name: before(self._first[name], x) for name, x in named.items()}
        rows = self._env.entries(before(self._observed, observation), earlier)
        following = self._env.entries(observation, named)
        following.set(keys.REWARD, torch.from_numpy(reward)[:, None])
        # An episode that goes on after its last step was cut off.
        is_last = np.zeros(len(world), dtype=bool)
        is_last[np.append(begins[1:], len(world)) - 1] = True
        goes_on = ~following[keys.DONE].flatten()
        mark_truncated(following, torch.from_numpy(is_last) & goes_on)
        lengths = np.diff(begins, append=len(world))
        added = {
            keys.ACTION: action,
            "member": offset[0] + world // trials,
            "episode": offset[1] + world % trials,
            "time": np.arange(len(world)) - np.repeat(begins, lengths),
        }
        for name, values in added.items():
            rows.set(name, torch.from_numpy(values))
        return rows.set("next", following)
