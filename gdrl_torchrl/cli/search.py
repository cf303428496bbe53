"""``gdrl-search +search=<name> ...``: look for good settings, with Optuna.

Started again it goes on; several processes may work at one search at a time.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib.util
import json
import logging
import os
import shlex
import statistics
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override, Transformer
from omegaconf import OmegaConf

from gdrl_torchrl.cli.shared.arguments import CommandParser, fail
from gdrl_torchrl.cli.shared.compose import EXIT_SAVED, composed, load_experiment
from gdrl_torchrl.cli.shared.errors import check_known, explained, not_among
from gdrl_torchrl.cli.shared.names import names_in, sentence_of
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.config.search import SearchConfig
from gdrl_torchrl.config.sentences import options_of
from gdrl_torchrl.files.fields import RATE, read_object
from gdrl_torchrl.files.safe_files import locked, open_own

_logger = logging.getLogger(__name__)
_DESCRIPTION = (
    "Look for good settings with Optuna: trials of settings, the best of which is printed "
    "last, as a command. Started again, it goes on; several may work at one search."
)
_EXAMPLES = (
    "gdrl-search +search=gppo_water",
    "gdrl-search +search=gppo_water search.num_trials=60 task.sea=rough",
)
_ERROR = "error"


def load_search(arguments: list[str]) -> SearchConfig:
    """Compose a search; overrides that are not its own become those of its runs.

    Raises:
        ValueError: If no search is named, or a value or an override is not valid.

    Examples:
        >>> search = load_search(["+search=gppo_water", "search.num_trials=3", "seed=1"])
        >>> search.num_trials, search.overrides
        (3, ['experiment=gppo_water', 'seed=1'])
    """
    named = [a for a in arguments if a.lstrip("+").startswith("search=")]
    names = [argument.partition("=")[2] for argument in named]
    if len(names) != 1:
        given = " ".join(named) or "+search=<name>"
        raise ValueError(f"{given} must be given once: see gdrl-search --help")
    if names[0] not in names_in("search"):
        raise ValueError(not_among("+search", names[0], names_in("search")))
    others = [a for a in arguments if a not in named]
    own = [a for a in others if a.lstrip("+~").startswith("search.")]
    config = composed(f"search/{names[0]}", own)
    with explained(own):
        check_known(config)
        search = OmegaConf.to_object(config.search)
    assert isinstance(search, SearchConfig)
    search.overrides += [a for a in others if a not in own]
    return search


class _SettingsError(Exception):
    """A trial whose settings are not valid, or do not train."""


class Search:
    """Trials of one search, remembered in the folder of its runs.

    Args:
        config: The search.
        run: Brings a run of a configuration and the overrides that it was made of to its
            end, and returns its directory.

    Raises:
        ValueError: If a parameter has nothing to choose from, a run cannot be composed,
            or is one of toy size.
    """

    def __init__(self, config: SearchConfig, run: Callable[[Any, list[str]], Path]) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.config, self.run = config, run
        texts = [f"{name}={choices}" for name, choices in config.params.items()]
        with explained(texts):
            self.params = OverridesParser.create().parse_overrides(texts)
        for param in self.params:
            if not param.is_sweep_override():
                text = f"search.params: {param.input_line} has nothing to choose from"
                raise ValueError(text)
        example = load_experiment(
            self._overrides([], config.seeds[0], config.total_steps[0])
        )
        if example.toy:
            text = "toy=true takes sizes of its own, whatever a trial has chosen"
            raise ValueError(text)
        self.folder = Path(example.runs_dir) / config.name
        self.folder.mkdir(parents=True, exist_ok=True)
        # Two processes must not both make what is not there yet.
        with self._turn():
            self.study = optuna.create_study(
                study_name=_study_name(config),
                storage=_storage(config.storage, self.folder),
                direction="maximize",
                pruner=optuna.pruners.MedianPruner(),
                load_if_exists=True,
            )

    def optimize(self) -> None:
        """Run trials until there are enough, those that other processes run included.

        Raises:
            InterruptedRunError: If a signal ended a run.
            RunDirectoryError: If a run's directory cannot be used, as on a full disk.
            OSError: If the trials cannot be written.
        """
        while True:
            with contextlib.ExitStack() as stack:
                trial = self._next_trial(stack)
                if trial is None:
                    return
                self._try(trial)

    def _next_trial(self, stack: contextlib.ExitStack) -> Any:
        """A trial that no other process has, locked; None if there are enough."""
        import optuna

        # Others must neither count nor take up a trial before its process has locked it.
        with self._turn():
            finished, running = self._count()
            if finished + running >= self.config.num_trials:
                if running:
                    _logger.warning("%d trials still run in other processes", running)
                return None
            trial = self.study.ask()
            stack.enter_context(self._locked(trial.number))
        # Neither another process nor a restart may draw the same numbers again.
        seed = self.config.sampler_seed + trial.number
        self.study.sampler = optuna.samplers.TPESampler(seed=seed)
        return trial

    def finished(self) -> list[Any]:
        """Trials that have ended, by an error too, but not by a signal."""
        return list(filter(_has_ended, self.study.get_trials(deepcopy=False)))

    def best(self) -> Any:
        """The best trial with the largest budget, or None."""
        complete = [t for t in self.finished() if t.state.name == "COMPLETE"]
        return max(complete, key=lambda trial: trial.value, default=None)

    def _try(self, trial: Any) -> None:
        from optuna.trial import TrialState

        chosen = [_suggest(trial, param) for param in self.params]
        trial.set_user_attr("overrides", chosen)
        try:
            value, pruned = self._value(trial, chosen)
        # Whatever else ends a run says nothing about settings: the trial is taken up.
        except _SettingsError as error:
            trial.set_user_attr(_ERROR, str(error))
            self.study.tell(trial, state=TrialState.FAIL)
            _logger.warning("trial %d: %s: %s", trial.number, " ".join(chosen), error)
            return
        state = TrialState.PRUNED if pruned else TrialState.COMPLETE
        # Optuna takes a pruned trial's value from its reports.
        self.study.tell(trial, None if pruned else value, state)
        word = "ended early" if pruned else "done"
        _logger.warning("trial %d %s: %.3f %s", trial.number, word, value, " ".join(chosen))

    def _value(self, trial: Any, chosen: list[str]) -> tuple[float, bool]:
        """Mean success rate, and whether the trial was ended before its last budget."""
        budgets, value = self.config.total_steps, 0.0
        for budget in budgets:
            rates = []
            for seed in self.config.seeds:
                # A run with a larger budget goes on where it was.
                path = self._trained(chosen, seed, budget)
                told = read_object(path / "evaluation.json", {"success_rate": RATE})
                rates.append(told["success_rate"])
            value = statistics.fmean(rates)
            trial.report(value, budget)
            if budget != budgets[-1] and trial.should_prune():
                return value, True
        return value, False

    def _trained(self, chosen: list[str], seed: int, budget: int) -> Path:
        """A run of a trial; what its settings are to blame for becomes one error."""
        from gdrl_torchrl.runs.run import TrainingDivergedError

        overrides = self._overrides(chosen, seed, budget)
        try:
            return self.run(load_experiment(overrides), overrides)
        # A file that the system cannot read is a ValueError too.
        except OSError:
            raise
        except (ValueError, TrainingDivergedError) as error:
            raise _SettingsError(f"{type(error).__name__}: {error}") from error

    def _overrides(self, chosen: list[str], seed: int, budget: int) -> list[str]:
        config = self.config
        return [
            *config.overrides,
            *chosen,
            f"name={config.name}",
            f"seed={seed}",
            "budget.agent_steps=null",
            "budget.wall_s=null",
            f"budget.total_steps={budget}",
            f"evaluation.seed={config.evaluation_seed}",
            f"evaluation.episodes={config.episodes}",
            "logger.tensorboard=false",
            "logger.video_episodes=0",
        ]

    def _count(self) -> tuple[int, int]:
        """How many trials have ended, and how many run in other processes.

        Those whose process is no more are queued again; their runs will go on.
        """
        ended = running = 0
        for trial in self.study.get_trials(deepcopy=False):
            if trial.state.name == "RUNNING":
                try:
                    with self._locked(trial.number):
                        # It may have ended since, and each counts once.
                        ended += self._has_ended_or_is_taken_up(trial.number)
                except BlockingIOError:
                    running += 1
            else:
                ended += _has_ended(trial)
        return ended, running

    def _has_ended_or_is_taken_up(self, number: int) -> bool:
        from optuna.trial import TrialState

        trial = self.study.get_trials(deepcopy=False)[number]
        if trial.state == TrialState.RUNNING:
            self.study.enqueue_trial(trial.params)
            self.study.tell(number, state=TrialState.FAIL)
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


def _suggest(trial: Any, param: Override) -> str:
    """The override that a trial chooses; ``choice`` and ``range`` have no order."""
    name, values = param.get_key_element(), param.value()
    if not isinstance(values, IntervalSweep):
        iterator = param.sweep_iterator(transformer=Transformer.encode)
        return f"{name}={trial.suggest_categorical(name, list(map(str, iterator)))}"
    low, high, log = values.start, values.end, "log" in values.tags
    if isinstance(low, int):
        return f"{name}={trial.suggest_int(name, low, high, log=log)}"
    return f"{name}={trial.suggest_float(name, low, high, log=log):.4g}"


def _study_name(config: SearchConfig) -> str:
    """Another question is another study, though it has the same name."""
    question = dataclasses.asdict(config)
    for name in ("num_trials", "storage", "sampler_seed"):
        del question[name]
    digest = hashlib.sha256(json.dumps(question, sort_keys=True).encode()).hexdigest()
    return f"{config.name}-{digest[:8]}"


def _storage(kind: str, folder: Path) -> Any:
    from optuna.storages import JournalStorage

    from gdrl_torchrl.cli.search_journal import SearchJournal

    if kind == "sqlite":
        path = folder / "search.sqlite"
        os.close(open_own(path, os.O_RDWR | os.O_CREAT))
        return f"sqlite:///{path.absolute()}"
    return JournalStorage(SearchJournal(folder / "search.journal"))


def _has_ended(trial: Any) -> bool:
    return trial.state.is_finished() and (trial.value is not None or bool(_error_of(trial)))


def _error_of(trial: Any) -> str | None:
    return trial.user_attrs.get(_ERROR)


def search_table(search: Search) -> str:
    """The finished trials, the best first: value, state, number, overrides."""
    trials = sorted(search.finished(), key=lambda trial: -(trial.value or 0.0))
    lines = []
    for trial in trials:
        value = "  -  " if trial.value is None else f"{trial.value:.3f}"
        chosen = " ".join(trial.user_attrs["overrides"])
        lines.append(f"{value}  {trial.state.name.lower():8}  {trial.number:4}  {chosen}")
    return "\n".join(lines)


def _parser() -> CommandParser:
    searches = [(name, sentence_of("search", name)) for name in names_in("search")]
    rest = [
        ("<option>=<value>", "An option of all runs, which gdrl-train --help lists."),
    ]
    return CommandParser(
        "gdrl-search",
        "+search=<name> [search.<option>=<value> ...] [<option>=<value> ...]",
        _DESCRIPTION,
        [
            ("+search=<name>", searches),
            ("options", [*options_of(SearchConfig, "search"), *rest]),
        ],
        _EXAMPLES,
    )


def main() -> None:
    """Entry point of ``gdrl-search``."""
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    try:
        config = load_search(_parser().parse_args().arguments)
        # What is wrong is said before anything is loaded that takes long.
        make_task_of(load_experiment(config.overrides))
    except ValueError as error:
        fail(error)
    if importlib.util.find_spec("optuna") is None:
        fail("gdrl-search needs Optuna: pip install 'gdrl_torchrl[search]'")
    # Imported here so that a wrong argument is answered without them.
    from optuna.exceptions import OptunaError
    from sqlalchemy.exc import SQLAlchemyError

    from gdrl_torchrl.agents.collectors.worker import WorkerDiedError
    from gdrl_torchrl.files.errors import RunDirectoryError
    from gdrl_torchrl.runs.run import InterruptedRunError, run_experiment

    logging.getLogger("torchrl").setLevel(logging.WARNING)
    try:
        search = Search(config, run_experiment)
        search.optimize()
    except (
        *(OSError, MemoryError, RunDirectoryError, WorkerDiedError),
        *(OptunaError, SQLAlchemyError),
    ) as error:
        reason = str(error) or type(error).__name__
        fail(f"{reason}. The same command goes on with the trial that ran")
    except ValueError as error:
        fail(error)
    except InterruptedRunError as stop:
        print(stop, file=sys.stderr)
        sys.exit(EXIT_SAVED)
    print(search_table(search))
    best = search.best()
    if best is not None:
        overrides = [*config.overrides, *best.user_attrs["overrides"]]
        print(shlex.join(["gdrl-train", *overrides]))
    failed = [trial for trial in search.finished() if _error_of(trial)]
    if failed:
        sys.exit(
            f"error: {len(failed)} trials failed, the last one: {_error_of(failed[-1])}"
        )


if __name__ == "__main__":
    main()
