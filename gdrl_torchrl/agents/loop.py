"""The loop that trains every agent: collect, learn, evolve, report."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, Literal

from tensordict import TensorDictBase

from gdrl_torchrl.agents.base import Learner
from gdrl_torchrl.agents.collectors.collects import Collects

Stage = Literal["batch_process", "pre_steps_log", "post_optim", "post_steps"]
"""As TorchRL's trainers name them: a batch has come, it is about to be learnt from, it
has been learnt from, and the end of a step."""
STAGES: tuple[Stage, ...] = ("batch_process", "pre_steps_log", "post_optim", "post_steps")


class TrainingLoop:
    """Collects batches, learns from each, and calls hooks at the stages of a step.

    Hooks register as with TorchRL's trainers, so that those of this package serve both.
    Nothing is averaged, logged or saved here: hooks do that.

    Args:
        learner: Learns from batches; None, with no collector, trains by hooks alone.
        collector: Gives batches.

    Attributes:
        collected_frames: Environment steps of the agent.

    Examples:
        >>> loop, steps = TrainingLoop(), []
        >>> loop.register_op("post_steps", lambda: steps.append(0))
        >>> loop.register_op("post_steps", loop.request_stop)
        >>> loop.train()
        >>> len(steps)
        1
    """

    def __init__(
        self, learner: Learner | None = None, collector: Collects | None = None
    ) -> None:
        self.learner, self.collector = learner, collector
        self.collected_frames = 0
        self._hooks: dict[str, list[Callable]] = {stage: [] for stage in STAGES}
        self._stops = False

    def register_op(self, dest: Stage, op: Callable, **kwargs: Any) -> None:
        """Call ``op`` at a stage of every step, in the order of registration.

        The first two stages give it the batch ``[W, T]``; what ``batch_process`` returns,
        unless it is None, is the batch from then on.

        Raises:
            ValueError: If there is no such stage.
        """
        if dest not in self._hooks:
            raise ValueError(f"dest={dest!r} must be one of {STAGES}")
        self._hooks[dest].append(functools.partial(op, **kwargs) if kwargs else op)

    def register_module(self, module_name: str, module: Any) -> None:
        """Do nothing: whoever made a part saves it."""

    def request_stop(self) -> None:
        """End after this step."""
        self._stops = True

    def train(self) -> None:
        """Step until asked to stop. The collector stays open."""
        self._stops = False
        nothing = itertools.repeat(None)
        for batch in nothing if self.collector is None else self.collector:
            if batch is not None:
                self._learn(batch)
            self._call("post_steps")
            if self._stops:
                return

    def state_dict(self) -> dict[str, Any]:
        """The steps so far."""
        return {"collected_frames": self.collected_frames}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        self.collected_frames = state_dict["collected_frames"]

    def _learn(self, batch: TensorDictBase) -> None:
        for process in self._hooks["batch_process"]:
            processed = process(batch)
            batch = batch if processed is None else processed
        self.collected_frames += batch.numel()
        self._call("pre_steps_log", batch)
        if self.learner is not None:
            self.learner.learn(batch)
        self._call("post_optim")

    def _call(self, stage: Stage, *args: Any) -> None:
        for hook in self._hooks[stage]:
            hook(*args)
