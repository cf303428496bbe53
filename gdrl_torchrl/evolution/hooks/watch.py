"""Watching the agent's episodes."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence


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
        """Whether an episode has begun and is not in the window yet."""
        return episode in self._open

    def forget_running(self) -> None:
        """Drop the episodes that have not ended: they never will."""
        ended = [result for result in self._open.values() if result is not None]
        self._finished.extend(ended)
        self._open.clear()

    def __len__(self) -> int:
        return len(self._finished)

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
