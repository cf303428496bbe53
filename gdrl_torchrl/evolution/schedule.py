"""How strongly to mutate, by the agent's current success."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Iterable, Sequence


@dataclasses.dataclass(frozen=True)
class MutationSchedule:
    """Mutation probability by success rate: ``rates[i]`` below ``thresholds[i]``.

    The papers give the rates (0.75, 0.4, 0.1) and not the thresholds.

    Examples:
        >>> schedule = MutationSchedule()
        >>> [schedule(success) for success in (None, 0.2, 0.5, 0.9)]
        [0.75, 0.75, 0.4, 0.1]
    """

    rates: tuple[float, ...] = (0.75, 0.4, 0.1)
    thresholds: tuple[float, ...] = (0.4, 0.8)

    def __post_init__(self) -> None:
        if len(self.rates) != len(self.thresholds) + 1:
            raise ValueError(
                f"rates={self.rates} must have one entry more than "
                f"thresholds={self.thresholds}"
            )
        if any(not 0.0 <= rate <= 1.0 for rate in self.rates):
            raise ValueError(f"rates={self.rates} must be in [0, 1]")
        if list(self.thresholds) != sorted(set(self.thresholds)):
            raise ValueError(f"thresholds={self.thresholds} must increase")

    def __call__(self, success_rate: float | None) -> float:
        """Rate for a success rate; None (not known yet) means the highest mutation."""
        if success_rate is None:
            return self.rates[0]
        return self.rates[sum(success_rate >= limit for limit in self.thresholds)]


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
