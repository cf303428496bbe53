"""The trials of one search, which several processes take one after another."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import JournalStorage
from optuna.trial import TrialState

from gdrl_torchrl.cli.trials.journal import SearchJournal
from gdrl_torchrl.files.safe_files import locked, open_own

_logger = logging.getLogger(__name__)
_ERROR, _REPEATS = "error", "repeats"
_REPEATS_TO_RANDOM, _REPEATS_TO_END = 10, 200


class SharedStudy:
    """An Optuna study in a folder; each of its trials is run by one process at a time.

    Args:
        folder: Where the trials are kept; it is made if there is none.
        name: Name of the study; a folder may hold several.
        storage: ``journal`` or ``sqlite``.

    Raises:
        OSError: If the folder or a file in it cannot be made.
    """

    def __init__(self, folder: Path, name: str, storage: str) -> None:
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        # Two processes must not both make what is not there yet.
        with self._turn():
            self._study = optuna.create_study(
                study_name=name,
                storage=_storage(storage, folder),
                direction="maximize",
                pruner=optuna.pruners.MedianPruner(),
                load_if_exists=True,
            )

    @contextlib.contextmanager
    def next_trial(self, num_trials: int, sampler_seed: int) -> Iterator[Any]:
        """Take a trial that no other process has, and keep it locked.

        After ten in a row whose settings were tried before, settings are drawn at random,
        and after 200 there is none.

        Args:
            num_trials: How many trials there may be, those of other processes included.
            sampler_seed: The trial's settings are drawn with this plus its number.

        Yields:
            The trial, or None if there are enough, or nothing new to try.
        """
        with contextlib.ExitStack() as stack:
            yield self._taken(stack, num_trials, sampler_seed)

    def _taken(
        self, stack: contextlib.ExitStack, num_trials: int, sampler_seed: int
    ) -> Any:
        # Others must neither count nor take up a trial before its process has locked it.
        with self._turn():
            finished, running = self._count()
            if finished + running >= num_trials:
                if running:
                    _logger.warning("%d trials still run in other processes", running)
                return None
            repeats = self._repeats()
            if repeats >= _REPEATS_TO_END:
                _logger.warning("every choice that is left was tried: %d trials", finished)
                return None
            trial = self._study.ask()
            stack.enter_context(self._locked(trial.number))
        # Neither another process nor a restart may draw the same numbers again.
        seed = sampler_seed + trial.number
        samplers = optuna.samplers
        kind = (
            samplers.RandomSampler if repeats >= _REPEATS_TO_RANDOM else samplers.TPESampler
        )
        self._study.sampler = kind(seed=seed)
        return trial

    def note_value(self, trial: Any, value: float) -> None:
        """Note what a trial reached in the end."""
        self._study.tell(trial, value, TrialState.COMPLETE)

    def note_pruned(self, trial: Any) -> None:
        """Note that a trial was ended early; its value is the last that it reported."""
        self._study.tell(trial, None, TrialState.PRUNED)

    def note_error(self, trial: Any, error: str) -> None:
        """Note that a trial's settings are not valid, or do not train."""
        trial.set_user_attr(_ERROR, error)
        self._study.tell(trial, state=TrialState.FAIL)

    def note_repeated(self, trial: Any) -> None:
        """Note that a trial's settings were tried before: it does not count."""
        trial.set_user_attr(_REPEATS, True)
        self._study.tell(trial, state=TrialState.FAIL)

    def finished(self) -> list[Any]:
        """Trials that have ended, by an error too, but not by a signal."""
        return list(filter(_has_ended, self._study.get_trials(deepcopy=False)))

    def _count(self) -> tuple[int, int]:
        """How many trials have ended, and how many run in other processes.

        Those whose process is no more are queued again; their runs will go on.
        """
        ended = running = 0
        for trial in self._study.get_trials(deepcopy=False):
            if trial.state == TrialState.RUNNING:
                try:
                    with self._locked(trial.number):
                        # It may have ended since, and each counts once.
                        ended += self._has_ended_or_is_taken_up(trial.number)
                except BlockingIOError:
                    running += 1
            else:
                ended += _has_ended(trial)
        return ended, running

    def _repeats(self) -> int:
        """How many of the newest trials, in a row, had settings that were tried before."""
        newest = reversed(self._study.get_trials(deepcopy=False))
        return sum(
            1 for _ in itertools.takewhile(lambda t: _REPEATS in t.user_attrs, newest)
        )

    def _has_ended_or_is_taken_up(self, number: int) -> bool:
        trial = self._study.get_trials(deepcopy=False)[number]
        if trial.state == TrialState.RUNNING:
            self._study.enqueue_trial(trial.params)
            self._study.tell(number, state=TrialState.FAIL)
            return False
        return _has_ended(trial)

    def _turn(self) -> contextlib.AbstractContextManager[None]:
        """Wait until no other process is between looking at trials and taking one."""
        return locked(self.folder / ".search.lock", wait=True)

    @contextlib.contextmanager
    def _locked(self, number: int) -> Iterator[None]:
        path = self.folder / f".trial_{number}.lock"
        with locked(path):
            yield
            # While it is held: nobody may lock a file that has no name any more.
            path.unlink(missing_ok=True)


def error_of(trial: Any) -> str | None:
    """The error that a trial ended with, if it did."""
    return trial.user_attrs.get(_ERROR)


def _has_ended(trial: Any) -> bool:
    return trial.state.is_finished() and (trial.value is not None or bool(error_of(trial)))


def _storage(kind: str, folder: Path) -> Any:
    if kind == "sqlite":
        path = folder / "search.sqlite"
        os.close(open_own(path, os.O_RDWR | os.O_CREAT))
        return f"sqlite:///{path.absolute()}"
    return JournalStorage(SearchJournal(folder / "search.journal"))
