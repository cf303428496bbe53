"""What went wrong in a run, kept in files: worlds that diverged, updates that did."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase

from gdrl_tasks.engines.divergence import DivergedWorld
from gdrl_torchrl.files.safe_files import own_folder, written_aside
from gdrl_torchrl.files.state import write_state

FOLDER = "faults"
_logger = logging.getLogger(__name__)


class NotFinite(Protocol):
    """An error about numbers that are not finite."""

    names: list[str]
    """What is not finite."""
    batch: TensorDictBase
    """Where: a minibatch ``[B]``, or a world's steps ``[T]``."""


class FaultFiles:
    """Writes faults of a run below its directory, and counts them.

    ``gdrl-replay`` reads the files.

    Args:
        run_dir: The run directory.
        task: The run's task: its settings by name.
        most_files: Most files that are kept.

    Attributes:
        num_diverged: Worlds that diverged, of the agent and of populations.
    """

    def __init__(self, run_dir: Path, task: Mapping[str, Any], most_files: int) -> None:
        self.folder = run_dir / FOLDER
        self.most = most_files
        self.num_diverged = 0
        self._task = dict(task)

    def note_world(self, diverged: DivergedWorld) -> None:
        """Count a world, and keep its last step if there is room for a file more."""
        self.num_diverged += 1
        name = f"diverged_{diverged.episode_seed}_{diverged.steps}.safetensors"
        content = {"kind": "diverged_world", "task": self._task}
        path = self._write(name, content | dataclasses.asdict(diverged))
        _logger.warning(
            "a world diverged in episode %d after %d steps%s",
            diverged.episode_seed,
            diverged.steps,
            f": gdrl-replay {path}" if path else "",
        )

    def note_update(self, error: NotFinite) -> Path | None:
        """Keep the minibatch of an update, or a world's steps of a batch that made none.

        Returns:
            The file, if there was room for it.
        """
        entries = error.batch.items(include_nested=True, leaves_only=True)
        batch = {_dotted(name): value for name, value in entries}
        content = {"kind": "update", "not_finite": error.names, "batch": batch}
        return self._write("update.safetensors", content)

    def _write(self, name: str, content: dict[str, Any]) -> Path | None:
        path = self.folder / name
        own_folder(self.folder)
        if not path.exists() and len(list(self.folder.iterdir())) >= self.most:
            return None
        with written_aside(path) as aside:
            write_state(aside, content)
        return path


def non_finite_entries(values: dict[str, torch.Tensor]) -> dict[str, int]:
    """How many numbers of each tensor are not finite, where some are not.

    Examples:
        >>> non_finite_entries({"a": torch.ones(2), "b": torch.tensor([1.0, torch.nan])})
        {'b': 1}
    """
    counts = {name: int((~torch.isfinite(x)).sum()) for name, x in values.items()}
    return {name: count for name, count in counts.items() if count}


def _dotted(name: Any) -> str:
    return name if isinstance(name, str) else ".".join(name)
