"""``gdrl-train experiment=<name> ...``: train or go on; prints the run directory.

``gdrl-train -m +sweep=<name>`` does so for every job of a sweep, one after another.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from gdrl_torchrl.analysis.run_files import read_evaluation
from gdrl_torchrl.cli.compose import (
    CONFIG_MODULE,
    EXIT_SAVED,
    register_configs,
    search_path,
    to_experiment,
)


@hydra.main(config_path=f"pkg://{CONFIG_MODULE}", config_name="config", version_base="1.3")
def _train(config: DictConfig) -> float:
    """Run one job; its value is the held-out success rate, for sweepers that search."""
    hydra_config = HydraConfig.get()
    in_sweep = hydra_config.mode == RunMode.MULTIRUN
    try:
        if in_sweep:
            check_launcher(hydra_config.launcher["_target_"])
        return _run_job(config, Path(hydra_config.runtime.cwd), in_sweep=in_sweep)
    except ValueError as error:
        if in_sweep:
            raise
        sys.exit(f"error: {error}")


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


def _run_job(config: DictConfig, started_in: Path, *, in_sweep: bool) -> float:
    experiment = to_experiment(config)
    if Path.cwd() != started_in:
        # With hydra.job.chdir, which must not lead runs elsewhere.
        runs_dir = str(started_in / experiment.runs_dir)
        experiment = dataclasses.replace(experiment, runs_dir=runs_dir)
    # Imported here so that --help is answered without them.
    from gdrl_torchrl.training.run import (
        InterruptedRunError,
        TrainingDivergedError,
        run_experiment,
    )
    from gdrl_torchrl.training.run_directory import RunDirectoryError
    from gdrl_torchrl.training.worker import WorkerDiedError

    # TorchRL reports on standard output, which is ours. Only now: importing it sets a
    # level of its own.
    for name in ("torchrl", "absl", "OpenGL"):
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        path = run_experiment(experiment)
    except InterruptedRunError as stop:
        if in_sweep and stop.__cause__ is not None:
            # Of a job system: its launcher tells who waits for the job.
            raise ValueError(str(stop)) from stop
        # Not an error of this job: it ends a sweep too. The terminal may be gone.
        with contextlib.suppress(OSError):
            print(stop, file=sys.stderr)
        sys.exit(EXIT_SAVED)
    except (RunDirectoryError, TrainingDivergedError, WorkerDiedError) as error:
        raise ValueError(str(error)) from error
    print(path)
    return float(read_evaluation(path)["success_rate"])


def main() -> None:
    """Entry point of ``gdrl-train``."""
    register_configs()
    if not any(argument.startswith("hydra.searchpath") for argument in sys.argv[1:]):
        # Beside the other overrides: they must follow each other.
        is_override = ["=" in a and not a.startswith("-") for a in sys.argv]
        place = is_override.index(True) if any(is_override) else len(sys.argv)
        sys.argv[place:place] = search_path()
    _train()


if __name__ == "__main__":
    main()
