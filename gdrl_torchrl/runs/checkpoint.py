"""Saving and restoring everything that a run's future depends on."""

from __future__ import annotations

import logging
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.checkpoint import Checkpoint, CheckpointAdapter, CheckpointError

from gdrl_torchrl.agents.base import HasState
from gdrl_torchrl.files.checkpoint import (
    ADAPTER,
    COMPONENT,
    STATE_FILE,
    read_checkpoint,
)
from gdrl_torchrl.files.safe_files import own_folder
from gdrl_torchrl.files.state import read_state, write_state
from gdrl_torchrl.runs.build import Training

_logger = logging.getLogger(__name__)
_SAVED = re.compile(r"checkpoint-\d{12,}\.torchrl")
# TorchRL's names too, while it writes one.
_UNFINISHED = re.compile(r"\.+checkpoint-\d+\.torchrl(\..*)?")


class TrainingState:
    """All state of a :class:`Training` as one ``state_dict``.

    Networks, optimiser, replay or order of minibatches, worlds, evolution, counters and
    the global torch generator. A dm_control environment has no state to restore: a run on
    that backend resumes with new episodes.

    Args:
        training: The objects.
        counters: A further part with ``state_dict`` and ``load_state_dict``.
        policies: Another one, if the run keeps policies.
    """

    def __init__(
        self, training: Training, counters: HasState, policies: HasState | None = None
    ) -> None:
        self.training = training
        self.counters, self.policies = counters, policies

    def _parts(self) -> dict[str, HasState]:
        """Those that there are, by name, in the order in which they are restored."""
        training, agent = self.training, self.training.agent
        parts: dict[str, Any] = {
            "actor": agent.actor,
            "loss": agent.loss,
            "optimizer": agent.optimizer,
            "learner": agent.learner,
            "watch": training.watch,
            "evolution": training.evolution,
            "loop": training.loop,
            "counters": self.counters,
            "policies": self.policies,
            "collector": agent.collector,
        }
        return {name: part for name, part in parts.items() if part is not None}

    def state_dict(self) -> dict[str, Any]:
        """State as nested dicts of tensors and plain values."""
        state: dict[str, Any] = {
            name: dict(part.state_dict()) for name, part in self._parts().items()
        }
        return state | {"generator": torch.get_rng_state()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Return to a state of :meth:`state_dict`."""
        for name, part in self._parts().items():
            part.load_state_dict(state_dict[name])
        # Last: whatever came before must not have drawn from it.
        torch.set_rng_state(state_dict["generator"].to(torch.uint8))


class Checkpoints:
    """The last few checkpoints of a run: one file each, written aside, flushed, renamed.

    A file is TorchRL's archive, whose members carry checksums, and holds no pickle.

    Args:
        folder: Where they are. Only the process that holds the run's lock may use it.
        state: What is saved: ``state_dict`` and ``load_state_dict``.
        identity: What a checkpoint must agree with to be loaded: names and values.
        keep: How many are kept.
    """

    def __init__(
        self,
        folder: Path,
        state: Any,
        identity: Mapping[str, str | int],
        *,
        keep: int = 2,
    ) -> None:
        self.folder = folder
        self.identity = dict(identity)
        self.keep = keep
        self._state = state
        self._checkpoint = Checkpoint(format="archive").register(
            COMPONENT, state, adapter=SafetensorsAdapter()
        )

    def save(self, step: int) -> Path:
        """Save the state under a number of steps.

        Raises:
            OSError: If it cannot be written, as on a full disk, or the folder is a link;
                those before are whole.
        """
        own_folder(self.folder)
        path = self.folder / f"checkpoint-{step:012d}.torchrl"
        aside = self.folder / f".{path.name}"
        try:
            self._checkpoint.save(aside, metadata=self.identity)
            # Or a loss of power might leave the name without the content.
            flush_to_disk(aside)
            os.replace(aside, path)
        finally:
            aside.unlink(missing_ok=True)
        flush_to_disk(self.folder)
        self._prune(path)
        return path

    def load_latest(self) -> bool:
        """Restore the newest checkpoint that can be used; False if there is none at all.

        Those that are damaged or of another run are named in warnings, with what is
        wrong. Once one before them is restored they are moved aside, under a name that
        begins with ``refused-``.

        Raises:
            CheckpointError: If there are checkpoints, but none can be used; they stay.
            OSError: If the system cannot read one, or the folder is a link. It may well
                be whole: everything stays.
            MemoryError: If there is not enough memory to read one, likewise.
        """
        own_folder(self.folder)
        self._remove_unfinished()
        refused: dict[Path, str] = {}
        for path in reversed(saved_checkpoints(self.folder)):
            try:
                self._restore(path)
            except CheckpointError as error:
                refused[path] = f"{path.name}: {error}"
                _logger.warning("checkpoint refused: %s", refused[path])
            else:
                for other in refused:
                    _set_aside(other)
                return True
        if refused:
            raise CheckpointError(
                f"no checkpoint in {self.folder} can be used "
                f"({'; '.join(refused.values())}): remove the folder to start anew"
            )
        return False

    def _restore(self, path: Path) -> None:
        saved = read_checkpoint(path)
        for name, expected in self.identity.items():
            if saved.metadata.get(name) != expected:
                raise CheckpointError(
                    f"{name} is {saved.metadata.get(name)!r}, expected {expected!r}"
                )
        try:
            self._state.load_state_dict(saved.state)
        except (OSError, MemoryError):
            raise
        # Its checksums were right: it is of other parts than those that are here.
        except Exception as error:
            if is_out_of_memory(error):
                raise MemoryError(f"{path} cannot be restored: {error}") from error
            raise CheckpointError(f"it does not fit: {error!r}") from error

    def _prune(self, newest: Path) -> None:
        """Remove all but the last few up to what was just saved."""
        saved = [path for path in saved_checkpoints(self.folder) if path.is_file()]
        for path in saved[: saved.index(newest) + 1][: -self.keep]:
            path.unlink()

    def _remove_unfinished(self) -> None:
        """Remove what a killed process had not finished; nothing of other names."""
        for path in self.folder.iterdir():
            if _UNFINISHED.fullmatch(path.name):
                is_folder = path.is_dir() and not path.is_symlink()
                shutil.rmtree(path) if is_folder else path.unlink()


def is_out_of_memory(error: Exception) -> bool:
    """Whether there was not enough memory; torch's error is a RuntimeError like others.

    Examples:
        >>> is_out_of_memory(RuntimeError("DefaultCPUAllocator: can't allocate memory"))
        True
        >>> is_out_of_memory(RuntimeError("shapes differ"))
        False
    """
    return isinstance(error, MemoryError) or "can't allocate memory" in str(error)


def saved_checkpoints(folder: Path) -> list[Path]:
    """The checkpoints in a folder, the newest last; none if there is no folder."""
    return sorted(
        path for path in folder.glob("checkpoint-*") if _SAVED.fullmatch(path.name)
    )


def _set_aside(path: Path) -> None:
    """Rename a file that was refused, to a name that is free."""
    target = path.with_name(f"refused-{path.name}")
    number = 0
    while os.path.lexists(target):
        number += 1
        target = path.with_name(f"refused-{path.name}.{number}")
    path.rename(target)
    _logger.warning("%s is now %s", path, target.name)


class SafetensorsAdapter(CheckpointAdapter):
    """Saves a state of tensors, arrays and plain values as one safetensors file.

    TorchRL's own adapter reads archives of tensordict, which may hold pickles and so run
    code; this file has none: tensors, and an outline in JSON of where they belong.
    """

    adapter_id = ADAPTER

    def save(
        self, component: Any, path: Path, *, args: tuple[Any, ...], kwargs: Any
    ) -> None:
        """Write the state of a component below a path."""
        path.mkdir(parents=True, exist_ok=True)
        write_state(path / STATE_FILE, component.state_dict(*args, **kwargs))

    def load(
        self,
        component: Any,
        path: Path,
        *,
        map_location: Any,
        tensor_load_kwargs: Any,
        args: tuple[Any, ...],
        kwargs: Any,
    ) -> None:
        """Restore a component from below a path.

        Raises:
            CheckpointError: If the file is not one of :meth:`save`.
        """
        try:
            state = read_state(path / STATE_FILE)
        except ValueError as error:
            raise CheckpointError(str(error)) from error
        component.load_state_dict(state, *args, **kwargs)


def flush_to_disk(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def seed_everything(seed: int) -> None:
    """Seed the global generators of torch and NumPy and keep torch to one thread.

    Results of torch may differ between numbers of threads; networks of this size gain
    nothing from more than one.
    """
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 - libraries draw from it
    torch.set_num_threads(1)
