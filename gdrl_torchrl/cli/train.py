"""``gdrl-train experiment=<name> ...``: train or go on; prints the run directory.

``gdrl-train -m +sweep=<name>`` does so for every job of a sweep, one after another.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from gdrl_torchrl.cli import sweep
from gdrl_torchrl.cli.shared.arguments import fail, one_line
from gdrl_torchrl.cli.shared.compose import (
    EXIT_SAVED,
    register_configs,
    search_path,
    to_experiment,
)
from gdrl_torchrl.cli.shared.errors import (
    check_known_to_hydra,
    explained,
    wants_traceback,
)
from gdrl_torchrl.cli.shared.names import CONFIG_MODULE, names_in
from gdrl_torchrl.config.options import owner_of
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.files.errors import RunDirectoryError, RunInUseError
from gdrl_torchrl.files.evaluation import read_evaluation

_OPTIONS_OF_HYDRA = (
    "--cfg",
    "--config-dir",
    "--config-name",
    "--config-path",
    "--experimental-rerun",
    "--hydra-help",
    "--info",
    "--multirun",
    "--package",
    "--resolve",
    "--run",
    "--shell-completion",
    "--version",
)


@hydra.main(config_path=f"pkg://{CONFIG_MODULE}", config_name="config", version_base="1.3")
def _train(config: DictConfig) -> float:
    """Run one job; its value is the held-out success rate, for sweepers that search."""
    hydra_config: Any = HydraConfig.get()
    in_sweep = hydra_config.mode == RunMode.MULTIRUN
    try:
        check_known_to_hydra(hydra_config)
        if in_sweep:
            check_launcher(hydra_config.launcher["_target_"])
        started_in = Path(hydra_config.runtime.cwd)
        path = _run_job(config, hydra_config.overrides.task, started_in, in_sweep=in_sweep)
        sweep.note(path=str(path))
        return float(read_evaluation(path)["success_rate"])
    except RunInUseError as error:
        if not in_sweep:
            fail(error)
        sweep.note(skipped=f"{error.path} runs elsewhere")
        return math.nan
    except ValueError as error:
        if not in_sweep:
            fail(error)
        # Not raised: Hydra would print where, and end the sweep's report.
        given = " ".join(hydra_config.overrides.task)
        sweep.note(error=f"job {hydra_config.job.num} ({given}): {one_line(error)}")
        return math.nan


def check_launcher(target: str) -> None:
    """Raise ValueError if a launcher is known to break runs.

    Examples:
        >>> check_launcher("hydra._internal.core_plugins.basic_launcher.BasicLauncher")
    """
    if "joblib" in target:
        raise ValueError(
            "hydra/launcher=joblib: its workers cannot start processes of their own (no "
            "context 'loky'), as TorchRL's parallel environments do: take basic or a "
            "launcher that gives each job a process, such as submitit_local"
        )


def _run_job(
    config: DictConfig, overrides: Sequence[str], started_in: Path, *, in_sweep: bool
) -> Path:
    """Bring a job's run to its end; its directory."""
    experiment = to_experiment(config)
    for name in ("absl", "OpenGL"):
        logging.getLogger(name).setLevel(logging.WARNING)
    # What is wrong is said before torch is imported, which takes seconds.
    make_task_of(experiment)
    if Path.cwd() != started_in:
        # With hydra.job.chdir, which must not lead runs elsewhere.
        runs_dir = str(started_in / experiment.runs_dir)
        experiment = dataclasses.replace(experiment, runs_dir=runs_dir)
    from gdrl_torchrl.agents.collectors.worker import WorkerDiedError
    from gdrl_torchrl.runs.run import (
        InterruptedRunError,
        TrainingDivergedError,
        run_experiment,
    )

    # TorchRL reports on standard output, which is ours. Only now: importing it sets a
    # level of its own.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    try:
        return run_experiment(experiment, overrides)
    except InterruptedRunError as stop:
        if in_sweep and stop.__cause__ is not None:
            # Of a job system: the sweep tells who waits for the job.
            raise ValueError(str(stop)) from stop
        # Not an error of this job: it ends a sweep too. The terminal may be gone.
        with contextlib.suppress(OSError):
            print(stop, file=sys.stderr)
        sys.exit(EXIT_SAVED)
    except RunInUseError:
        raise
    except (RunDirectoryError, TrainingDivergedError, WorkerDiedError) as error:
        raise ValueError(str(error)) from error


def main() -> None:
    """Entry point of ``gdrl-train``."""
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments):
        # Not Hydra's, which lists names without meanings; its own is --hydra-help.
        from gdrl_torchrl.cli.shared.help import help_of_training

        print(help_of_training(arguments), end="")
        return
    _check(arguments)
    register_configs()
    if not any(argument.startswith("hydra.searchpath") for argument in arguments):
        # Beside the other overrides: they must follow each other.
        is_override = ["=" in a and not a.startswith("-") for a in sys.argv]
        place = is_override.index(True) if any(is_override) else len(sys.argv)
        sys.argv[place:place] = search_path()
    if wants_traceback():
        _train()
        return
    # Or Hydra would print errors in its own words, of several lines.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        with explained(arguments):
            _train()
    except ValueError as error:
        fail(error)
    if sweep.failed:
        fail(f"jobs that failed: {len(sweep.failed)}, the last one: {sweep.failed[-1]}")


def _check(arguments: Sequence[str]) -> None:
    """End the command for mistakes that Hydra would take or answer with a page."""
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name.startswith("--") and name not in _OPTIONS_OF_HYDRA:
            given = f"{name.strip('-')}={value or '<value>'}"
            if owner_of(name.strip("-")) or names_in(name.strip("-")):
                fail(f"{argument} must be written {given}")
            fail(f"{argument} must be a switch that exists: see gdrl-train --help")
    if not any(argument.startswith(("-", "hydra.mode=")) for argument in arguments):
        for argument in arguments:
            if argument.startswith("+sweep="):
                fail(f"{argument} must come after -m: gdrl-train -m {' '.join(arguments)}")


if __name__ == "__main__":
    main()
