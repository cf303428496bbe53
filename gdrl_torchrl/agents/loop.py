"""Loops that train."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class GenerationLoop:
    """A trainer that does nothing but call its hooks, over and over.

    Examples:
        >>> loop, steps = GenerationLoop(), []
        >>> loop.register_op("post_steps", lambda: steps.append(0))
        >>> loop.register_op("post_steps", loop.request_stop)
        >>> loop.train()
        >>> len(steps)
        1
    """

    def __init__(self) -> None:
        self.collected_frames = 0
        self._hooks: list[Callable[[], object]] = []
        self._stops = False

    def register_op(self, dest: str, op: Callable, **kwargs: Any) -> None:
        """Call ``op`` in every step; there are no batches for other stages."""
        if dest == "post_steps":
            self._hooks.append(op)

    def register_module(self, module_name: str, module: Any) -> None:
        """Nothing: parts are saved by who made them."""

    def request_stop(self) -> None:
        """End after this step."""
        self._stops = True

    def train(self) -> None:
        """Step until asked to stop."""
        self._stops = False
        while not self._stops:
            for hook in self._hooks:
                hook()
