"""The runs of a study, which any number of processes take one after another."""

from __future__ import annotations

import dataclasses
import logging
import statistics
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.config.study import StudyConfig
from gdrl_torchrl.config.task import check_fits_policy, make_task_from_config
from gdrl_torchrl.files.errors import RunInUseError
from gdrl_torchrl.files.evaluation import read_curve, read_evaluation
from gdrl_torchrl.files.run_table import state_of
from gdrl_torchrl.runs.errors import TrainingDivergedError
from gdrl_torchrl.runs.place import code_version, directory_of, provenance, run_key
from gdrl_torchrl.studies.elsewhere import RATES, evaluate_elsewhere
from gdrl_torchrl.studies.protocol import (
    Job,
    jobs_of,
    overrides_of,
    protocol_of,
    protocol_sha256,
)
from gdrl_torchrl.studies.results import StudyResults

_logger = logging.getLogger(__name__)
Load = Callable[[list[str]], ExperimentConfig]
Run = Callable[[ExperimentConfig, list[str]], Path]


class Study:
    """A study at work: what is to be run, and what was.

    Args:
        config: The protocol.
        folder: Folder of results of all studies.
        load: Makes a run's configuration from overrides.
        common: Overrides of all runs that change no result, such as ``runs_dir``.

    Raises:
        ValueError: If a run cannot be composed, is one of toy size, or could not act in
            other worlds that it is to be evaluated on.
    """

    def __init__(
        self,
        config: StudyConfig,
        folder: Path,
        load: Load,
        common: list[str] | None = None,
    ) -> None:
        self.config = config
        self.protocol = protocol_of(config)
        self.results = StudyResults(folder / config.name)
        self.jobs = jobs_of(config)
        self._overrides = {
            arm: [*overrides_of(config, *arm), *(common or [])]
            for arm in dict.fromkeys((job.task, job.method) for job in self.jobs)
        }
        # Composed once each: what is wrong is said before anything is run.
        self._configs = {arm: load(given) for arm, given in self._overrides.items()}
        if any(experiment.toy for experiment in self._configs.values()):
            raise ValueError("toy=true takes sizes of its own, whatever the study says")
        self._elsewhere = {
            arm: self._other_worlds(load, arm, config.elsewhere.get(arm[0], {}))
            for arm in self._overrides
        }

    def _other_worlds(
        self, load: Load, arm: tuple[str, str], worlds: dict[str, list[str]]
    ) -> dict[str, ExperimentConfig]:
        """The configuration of an arm with each of its other tasks, by name."""
        trained = make_task_from_config(self._configs[arm].task)
        found = {}
        for name, overrides in worlds.items():
            # Only the task is taken of it, so that nothing else can differ.
            other = load([*self._overrides[arm], *overrides]).task
            given = f"study.elsewhere.{arm[0]}.{name}: {' '.join(overrides)}"
            check_fits_policy(trained, make_task_from_config(other), given)
            found[name] = dataclasses.replace(self._configs[arm], task=other)
        return found

    def missing(self) -> list[Job]:
        """Runs that have no results yet, in the order in which they are to be run."""
        ended = self.results.jobs()
        return [job for job in self.jobs if job not in ended]

    def work(self, run: Run) -> list[Job]:
        """Bring runs to their ends until there is none that no other process has.

        Args:
            run: Brings a run to its end and returns its directory.

        Returns:
            Runs that other processes are at.

        Raises:
            ValueError: If the results here are of another protocol.
            InterruptedRunError: If a signal ended a run.
            RunDirectoryError: If a run's directory cannot be used, as on a full disk.
        """
        self.results.begin(self.protocol)
        while missing := self.missing():
            tried = [self._try(job, run) for job in missing]
            if not any(tried):
                return missing
        return []

    def config_of(self, job: Job) -> ExperimentConfig:
        """The configuration of a run."""
        return dataclasses.replace(self._configs[job.task, job.method], seed=job.seed)

    def _try(self, job: Job, run: Run) -> bool:
        """Whether a run has ended, now or, in another process, since we looked."""
        if job in self.results.jobs():
            return True
        config = self.config_of(job)
        overrides = [*self._overrides[job.task, job.method], f"seed={job.seed}"]
        worlds = self._elsewhere[job.task, job.method]
        try:
            path = run(config, overrides)
            row, curve = _results_of(path)
            others = {name: evaluate_elsewhere(path, w) for name, w in worlds.items()}
        except RunInUseError:
            return False
        except TrainingDivergedError as error:
            # A crash counts as no success at all: leaving it out would flatter a method.
            row, curve = _failure(config, error), []
            others = dict.fromkeys(worlds, dict.fromkeys(RATES, 0.0))
        described = {
            "protocol": protocol_sha256(self.protocol)[:12],
            **dataclasses.asdict(job),
        }
        made_with = {
            "configuration": run_key(config),
            "code": code_version(),
            "packages": " ".join(f"{n} {v}" for n, v in provenance()["packages"].items()),
        }
        self.results.add(
            described | row | made_with,
            [described | point for point in curve],
            [described | {"worlds": n} | rates for n, rates in others.items()],
        )
        _logger.warning(
            "%s %s seed %d: area %.3f, success %.3f, %.0f s",
            *(job.task, job.method, job.seed),
            *(row["area"], row["success_rate"], row["wall_s"]),
        )
        return True

    def status(self) -> str:
        """A line a task and method: runs by state, and what is left of the whole."""
        ended = self.results.jobs()
        seconds: dict[tuple[str, str], list[float]] = {}
        for row in self.results.runs():
            seconds.setdefault((row["task"], row["method"]), []).append(row["wall_s"])
        states = {job: ended.get(job) or self._state(job) for job in self.jobs}
        lines, left_s, running = [], 0.0, 0
        known = [s for of_arm in seconds.values() for s in of_arm]
        for task, method in self._configs:
            of_arm = [
                s for job, s in states.items() if (job.task, job.method) == (task, method)
            ]
            counts = Counter(of_arm)
            told = ", ".join(f"{counts[s]} {s}" for s in _STATES if counts[s])
            lines.append(f"{task:16} {method:24} {told}")
            usual = statistics.median(seconds.get((task, method), known) or [0.0])
            left_s += usual * (len(of_arm) - counts["done"] - counts["failed"])
            running += counts["running"]
        if known and left_s:
            hours = left_s / 3600.0 / max(running, 1)
            lines.append(f"about {hours:.1f} h left with {max(running, 1)} at work")
        return "\n".join(lines)

    def _state(self, job: Job) -> str:
        path = directory_of(self.config_of(job)).path
        state = state_of(path) if path.is_dir() else "waiting"
        # Its results are still to be noted.
        return {"done": "stopped", "failed": "stopped"}.get(state, state)


_STATES = ("done", "failed", "running", "stopped", "waiting")


def _results_of(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """A run's row and the rows of its curve."""
    told, curve = read_evaluation(path), read_curve(path)
    row = {
        "state": "done",
        "area": statistics.fmean(p["success_rate"] for p in curve),
        "area_sampled": statistics.fmean(p["success_rate_sampled"] for p in curve),
        "return_mean": told["return_mean"],
        "episode_steps": told["steps_mean"],
        "episode_s": told["time_s_mean"],
        "speed_m_s": told["speed_m_s_mean"],
        "agent_episodes": curve[-1]["agent_episodes"],
        "error": "",
    }
    same = ("success_rate", "success_rate_sampled", *_COSTS)
    points = [
        {n: v for n, v in point.items() if n != "population_steps"} for point in curve
    ]
    return row | {name: told[name] for name in same}, points


def _failure(config: ExperimentConfig, error: Exception) -> dict[str, Any]:
    zeros = ("area", "area_sampled", "success_rate", "success_rate_sampled")
    unknown = ("return_mean", "episode_steps", "episode_s", "speed_m_s")
    return {
        "state": "failed",
        **dict.fromkeys(zeros, 0.0),
        **dict.fromkeys(unknown, float("nan")),
        **dict.fromkeys(_COSTS, 0),
        "total_steps": config.budget.total_steps or 0,
        "wall_s": 0.0,
        "agent_episodes": 0,
        "error": " ".join(str(error).split()),
    }


_COSTS = (
    *("agent_steps", "population_steps", "total_steps", "wall_s"),
    *("evaluations", "switches"),
)
