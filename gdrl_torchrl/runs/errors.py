"""What a run ends with, if not with a result: each says what to do."""

from __future__ import annotations

import contextlib
import errno
import signal
from collections.abc import Iterator
from pathlib import Path

from gdrl_torchrl.agents.collectors.finite_batches import NonFiniteBatchError
from gdrl_torchrl.agents.update import NonFiniteUpdateError
from gdrl_torchrl.files.directory import RunDirectory
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.runs.checkpoint import is_out_of_memory, saved_checkpoints

_GO_ON = (
    "checkpoints that were saved are whole: {0}, and the same command goes on from them"
)
_ADVICE = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), _GO_ON.format("free some space")),
    errno.EFBIG: _GO_ON.format("allow larger files (ulimit -f)"),
    **dict.fromkeys(
        (errno.EMFILE, errno.ENFILE), _GO_ON.format("allow more open files (ulimit -n)")
    ),
    **dict.fromkeys(
        (errno.ENOENT, errno.ESTALE, errno.ENOTCONN),
        "was something removed, or a disk taken away, while it ran? The same command goes "
        "on from the checkpoints that are left",
    ),
}


class InterruptedRunError(RuntimeError):
    """A signal ended a run; it was saved and can be resumed.

    Its cause is the error, if there was one, of who else had a handler for the signal, as
    job systems have.

    Attributes:
        signal: The signal.
        path: The run directory.
    """

    def __init__(self, number: signal.Signals, path: Path, answer: str = "") -> None:
        super().__init__(
            f"stopped by {number.name} and saved: the same command goes on with {path}"
            + answer
        )
        self.signal = number
        self.path = path


class TrainingDivergedError(RuntimeError):
    """What the task gave, or a loss, gradient or parameter, was not finite; that ended it.

    Attributes:
        path: The run directory.
        batch: File with the minibatch, or a world's steps of a batch, if one was written.
        checkpoint: The last checkpoint, from before; None if there was none yet.
    """

    def __init__(
        self,
        error: NonFiniteUpdateError | NonFiniteBatchError,
        directory: RunDirectory,
        batch: Path | None,
    ) -> None:
        saved = saved_checkpoints(directory.checkpoints)
        self.path, self.batch = directory.path, batch
        self.checkpoint = saved[-1] if saved else None
        super().__init__(
            f"{directory.path}: {error}; its batch: {batch or 'not kept'}; last good "
            f"checkpoint: {self.checkpoint or 'none yet'}. {error.advice}"
        )


@contextlib.contextmanager
def system_errors_named(path: Path) -> Iterator[None]:
    """Let errors of the system say which run they are about, and what to do.

    Raises:
        RunDirectoryError: In place of an OSError, or where memory ended.
    """
    try:
        yield
    except OSError as error:
        advice = _ADVICE.get(error.errno or 0)
        text = f"{path}: {error}" + (f"; {advice}" if advice else "")
        raise RunDirectoryError(text) from error
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise RunDirectoryError(
            f"{path}: there is not enough memory ({error or 'for what came next'}); "
            "checkpoints that were saved are whole: the same command goes on from them"
        ) from error
