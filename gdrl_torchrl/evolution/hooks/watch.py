"""Watching the agent's episodes: how many ended, and how well the last ones went."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.trainers.trainers import TrainerHookBase

from gdrl_torchrl import keys


class SuccessWindow:
    """Success over the last completed episodes, in the order in which they started.

    Short episodes finish first, so a window in the order of completion would favour
    them: an episode enters only when every episode that began before it has ended.

    Args:
        size: Number of episodes.

    Examples:
        >>> window = SuccessWindow(size=2)
        >>> window.begin([0, 1])
        >>> window.finish(1, True)
        >>> window.rate is None
        True
        >>> window.finish(0, False)
        >>> window.rate
        0.5
    """

    def __init__(self, size: int = 100) -> None:
        if size < 1:
            raise ValueError(f"size={size} must be >= 1")
        self.size = size
        self._finished: deque[bool] = deque(maxlen=size)
        self._open: dict[int, bool | None] = {}

    def begin(self, episodes: Iterable[int]) -> None:
        """Note episodes that start, in this order; each number is used once."""
        for episode in episodes:
            self._open[int(episode)] = None

    def finish(self, episode: int, success: bool) -> None:
        """Note that an episode ended."""
        if episode not in self._open:
            raise ValueError(f"episode={episode} has not begun")
        self._open[episode] = bool(success)
        while self._open:
            first, result = next(iter(self._open.items()))
            if result is None:
                return
            self._finished.append(result)
            del self._open[first]

    def is_open(self, episode: int) -> bool:
        """Whether an episode has begun and has not ended."""
        return self._open.get(episode, True) is None

    def clear(self) -> None:
        """Forget all that ended; what runs is waited for."""
        self._finished.clear()

    def forget_running(self) -> None:
        """Drop the episodes that have not ended: they never will."""
        ended = [result for result in self._open.values() if result is not None]
        self._finished.extend(ended)
        self._open.clear()

    def __len__(self) -> int:
        return len(self._finished)

    @property
    def num_successes(self) -> int:
        """Successes in the window."""
        return sum(self._finished)

    @property
    def rate(self) -> float | None:
        """Success rate once the window is full, else None."""
        return self.running_rate if len(self._finished) == self.size else None

    @property
    def running_rate(self) -> float | None:
        """Success rate of what is in the window; None if nothing is."""
        if not self._finished:
            return None
        return sum(self._finished) / len(self._finished)

    def state_dict(self) -> dict[str, Sequence[int]]:
        """State as plain lists."""
        return {
            "finished": [int(success) for success in self._finished],
            "open_episodes": list(self._open),
            "open_results": [-1 if r is None else int(r) for r in self._open.values()],
        }

    def load_state_dict(self, state: dict[str, Sequence[int]]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self._finished = deque((bool(s) for s in state["finished"]), maxlen=self.size)
        results = (None if r < 0 else bool(r) for r in state["open_results"])
        self._open = dict(zip(state["open_episodes"], results, strict=True))


class EpisodeWatch(TrainerHookBase):
    """Counts the agent's episodes, and keeps the success of the last ones.

    A bare agent has one too: budgets, tables and mutation rates are told by it.

    Args:
        window_episodes: Episodes that the success rate is over.
        success_key: Flag of success in the training batches.

    Attributes:
        window: Success of the last episodes.
        episodes_completed: Episodes that ended.
        is_registered: Whether a trainer's batches are watched.

    Examples:
        >>> from tensordict import TensorDict
        >>> done = torch.tensor([[False, True]])
        >>> batch = TensorDict({"next": {"done": done, "success": done}}, [1, 2])
        >>> watch = EpisodeWatch(window_episodes=1)
        >>> _ = watch.observe(batch.set("episode_number", torch.tensor([[3, 3]])))
        >>> watch.episodes_completed, watch.window.rate
        (1, 1.0)
    """

    def __init__(
        self, window_episodes: int = 100, *, success_key: str = keys.SUCCESS
    ) -> None:
        self.window = SuccessWindow(window_episodes)
        self.success_key = success_key
        self.episodes_completed = 0
        self.is_registered = False
        self._last_episode = -1

    def register(self, trainer: Any, name: str = "episode_watch") -> None:
        """Watch the batches of a trainer, which saves what was counted.

        Raises:
            ValueError: If the trainer collects asynchronously: it shows its hooks no
                batches, so no episode would ever be counted.
        """
        if getattr(trainer, "async_collection", False):
            raise ValueError(
                "async_collection=True: batches never reach the hook, so it would never "
                "evaluate; collect synchronously"
            )
        self.is_registered = True
        trainer.register_module(name, self)
        trainer.register_op("batch_process", self.observe)

    def observe(self, batch: TensorDictBase) -> TensorDictBase:
        """Count a batch's ended episodes and note their success, in starting order.

        Args:
            batch: Collected transitions ``[T]`` or ``[W, T]`` with ``episode_number``
                of the environment or, without it, the collector's trajectory ids.

        Returns:
            The batch itself.
        """
        done = batch["next", keys.DONE].reshape(-1)
        episode = batch.get(keys.EPISODE_NUMBER, None)
        if episode is None:
            episode = batch["collector", "traj_ids"]
        episode = episode.reshape(-1)
        self._note_starts(episode.unique().tolist())
        ended = episode[done]
        success = batch.get(("next", self.success_key), None)
        if success is None:
            flags = torch.zeros(len(ended), dtype=torch.bool)
        else:
            flags = success.reshape(-1)[done]
        for number, flag in zip(ended.tolist(), flags.tolist(), strict=True):
            self.window.finish(number, flag)
        self.episodes_completed += len(ended)
        return batch

    def note(self, successes: Iterable[bool]) -> None:
        """Note episodes that were played elsewhere, one after another.

        They are no training episodes: only the window has them.
        """
        for success in successes:
            self._last_episode += 1
            self.window.begin([self._last_episode])
            self.window.finish(self._last_episode, success)

    def _note_starts(self, episodes: list[int]) -> None:
        known = (n for n in episodes if n <= self._last_episode)
        if not all(self.window.is_open(number) for number in known):
            # An episode that had ended is back: numbers begin anew, as after a restart
            # with new episodes, and those that were running are gone.
            self.window.forget_running()
            self._last_episode = -1
        begun = [number for number in episodes if number > self._last_episode]
        self.window.begin(begun)
        if begun:
            self._last_episode = begun[-1]

    def state_dict(self) -> dict[str, Any]:
        """Window and counters."""
        return {
            "window": self.window.state_dict(),
            "episodes_completed": self.episodes_completed,
            "last_episode": self._last_episode,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.window.load_state_dict(state_dict["window"])
        self.episodes_completed = state_dict["episodes_completed"]
        self._last_episode = state_dict["last_episode"]
