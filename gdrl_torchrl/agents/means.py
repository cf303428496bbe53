"""Means of numbers that come up at every update, read once a row."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch


class Means:
    """Means of scalars by name since they were last taken.

    Tensors are kept as they are: to read a number of one takes longer than to keep it.

    Args:
        names: What is kept; other names that are added are left out.

    Examples:
        >>> means = Means(["loss", "entropy"])
        >>> means.add([("loss", torch.tensor(1.0)), ("other", torch.tensor(5.0))])
        >>> means.add([("loss", torch.tensor(3.0))])
        >>> means.take(), means.take()
        ({'loss': 2.0}, {})
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(dict.fromkeys(names))
        self._values: dict[str, list[torch.Tensor]] = {name: [] for name in self.names}

    def add(self, items: Iterable[tuple[str, torch.Tensor]]) -> None:
        """Keep scalars, detached, by their names."""
        for name, value in items:
            kept = self._values.get(name)
            if kept is not None:
                kept.append(value)

    def take(self) -> dict[str, float]:
        """Means of what was added, and forget it; names without any are missing."""
        means = {
            # Seven digits are all that single precision has.
            name: float(f"{float(torch.stack(values).mean()):.7g}")
            for name, values in self._values.items()
            if values
        }
        for values in self._values.values():
            values.clear()
        return means
