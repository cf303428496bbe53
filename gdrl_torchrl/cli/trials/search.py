"""A search: trials of settings, each trained and scored on held-out worlds."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override, Transformer

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.cli.shared.errors import explained
from gdrl_torchrl.cli.trials.study import SharedStudy
from gdrl_torchrl.config.search import SearchConfig
from gdrl_torchrl.files.fields import RATE, read_object

_logger = logging.getLogger(__name__)


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
        self.study = SharedStudy(self.folder, _study_name(config), config.storage)

    def optimize(self) -> None:
        """Run trials until there are enough, those that other processes run included.

        Raises:
            InterruptedRunError: If a signal ended a run.
            RunDirectoryError: If a run's directory cannot be used, as on a full disk.
            OSError: If the trials cannot be written.
        """
        config = self.config
        while True:
            with self.study.next_trial(config.num_trials, config.sampler_seed) as trial:
                if trial is None:
                    return
                self._try(trial)

    def finished(self) -> list[Any]:
        """Trials that have ended, by an error too, but not by a signal."""
        return self.study.finished()

    def best(self) -> Any:
        """The best trial with the largest budget, or None."""
        complete = [t for t in self.finished() if t.state.name == "COMPLETE"]
        return max(complete, key=lambda trial: trial.value, default=None)

    def _try(self, trial: Any) -> None:
        chosen = [_suggest(trial, param) for param in self.params]
        trial.set_user_attr("overrides", chosen)
        if any(chosen == other.user_attrs["overrides"] for other in self.finished()):
            self.study.note_repeated(trial)
            return
        try:
            value, pruned = self._value(trial, chosen)
        # Whatever else ends a run says nothing about settings: the trial is taken up.
        except _SettingsError as error:
            self.study.note_error(trial, str(error))
            _logger.warning("trial %d: %s: %s", trial.number, " ".join(chosen), error)
            return
        if pruned:
            self.study.note_pruned(trial)
        else:
            self.study.note_value(trial, value)
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
            "logger.figures=false",
            "logger.video_episodes=0",
        ]


def search_table(search: Search) -> str:
    """The finished trials, the best first: value, state, number, overrides."""
    trials = sorted(search.finished(), key=lambda trial: -(trial.value or 0.0))
    lines = []
    for trial in trials:
        value = "  -  " if trial.value is None else f"{trial.value:.3f}"
        chosen = " ".join(trial.user_attrs["overrides"])
        lines.append(f"{value}  {trial.state.name.lower():8}  {trial.number:4}  {chosen}")
    return "\n".join(lines)


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
