"""One run from start to end: train or go on, evaluate, draw."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchrl.checkpoint import CheckpointError

from gdrl_torchrl.agents.collectors.finite_batches import NonFiniteBatchError
from gdrl_torchrl.agents.collectors.worker import WorkerDiedError
from gdrl_torchrl.agents.update import NonFiniteUpdateError
from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.files.directory import RunDirectory
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.faults import FaultFiles
from gdrl_torchrl.files.metrics import MetricsTable
from gdrl_torchrl.runs.build import Training, build_training
from gdrl_torchrl.runs.checkpoint import (
    Checkpoints,
    TrainingState,
    flush_to_disk,
    seed_everything,
)
from gdrl_torchrl.runs.errors import (
    InterruptedRunError,
    TrainingDivergedError,
    system_errors_named,
)
from gdrl_torchrl.runs.kept_policies import KeptPolicies
from gdrl_torchrl.runs.monitor import RunMonitor, columns_of
from gdrl_torchrl.runs.place import (
    RUN_VERSION,
    code_version,
    directory_of,
    open_directory,
    run_key,
)
from gdrl_torchrl.runs.report import _make_logger, report_run
from gdrl_torchrl.runs.signals import StoppedError, StopSignals

_logger = logging.getLogger(__name__)


def run_experiment(config: ExperimentConfig, overrides: Sequence[str] = ()) -> Path:
    """Bring a run to its end and return its directory.

    A run that is complete under this configuration is returned as it is; one that was
    begun goes on from its last checkpoint.

    Args:
        config: The configuration.
        overrides: What was given on the command line; kept in the directory.

    Raises:
        ValueError: If the configuration is not valid.
        RunDirectoryError: If the directory cannot be used, the disk is full, or the system
            refuses something else.
        InterruptedRunError: If a signal stopped it.
        TrainingDivergedError: If something in a batch or an update was not finite.
        WorkerDiedError: If a process that collects was killed.
    """
    # What is wrong is said before anything is written.
    make_task_of(config)
    directory = directory_of(config)
    signals = StopSignals()
    with system_errors_named(directory.path):
        # Without the lock, which is a file: the disk may be one that is only read.
        if _is_complete(directory, config):
            _logger.info("already complete: %s", directory.path)
            return directory.path
        try:
            with signals, directory.locked():
                _bring_to_its_end(directory, config, signals, overrides)
            return directory.path
        except StoppedError:
            pass
    # Now the signals are no longer kept, nor is the directory.
    raise _answered(signals, directory.path)


def _answered(signals: StopSignals, path: Path) -> InterruptedRunError:
    """What to raise, once whoever else had handlers for the signals has answered them."""
    number = signals.received[0]
    stop = InterruptedRunError(number, path)
    try:
        signals.hand_on()
    except SystemExit:
        # As of a job that is queued again.
        _logger.warning("%s", stop)
        raise
    except Exception as error:
        stop = InterruptedRunError(number, path, f" ({type(error).__name__}: {error})")
        stop.__cause__ = error
    return stop


def _bring_to_its_end(
    directory: RunDirectory,
    config: ExperimentConfig,
    signals: StopSignals,
    overrides: Sequence[str],
) -> None:
    """Train or go on, evaluate and draw, unless another process has done so by now.

    Raises:
        StoppedError: If there was a signal; everything is saved.
    """
    if _is_complete(directory, config):
        return
    open_directory(directory, config, overrides)
    directory.done.unlink(missing_ok=True)
    directory.failed.unlink(missing_ok=True)
    try:
        costs = _run(directory, config, signals)
    except Exception as error:
        # On a full disk this fails as well, and must not hide the error.
        with contextlib.suppress(OSError):
            directory.write_json("FAILED", {"error": f"{type(error).__name__}: {error}"})
        raise
    directory.write_json(
        "DONE",
        {
            "version": RUN_VERSION,
            "code": code_version(),
            "costs": costs,
            "evaluation": dataclasses.asdict(config.evaluation),
        },
    )
    if signals.received:
        # Or a sweep would go on as if there had been none.
        raise StoppedError


def _run(
    directory: RunDirectory, config: ExperimentConfig, signals: StopSignals
) -> dict[str, Any]:
    seed_everything(config.seed)
    faults = FaultFiles(
        directory.path, dataclasses.asdict(config.task), config.faults.most_files
    )
    training = build_training(config, on_divergence=faults.note_world)
    try:
        with contextlib.closing(training):
            costs, kept = _train(directory, config, training, faults, signals)
        with signals.ending_at_once():
            report_run(directory, config, training, faults, costs, kept)
    except (NonFiniteUpdateError, NonFiniteBatchError) as error:
        batch = faults.note_update(error)
        raise TrainingDivergedError(error, directory, batch) from error
    except WorkerDiedError as error:
        raise WorkerDiedError(
            f"{directory.path}: {error}. The same command goes on from the last checkpoint"
        ) from error
    return costs


def _is_complete(directory: RunDirectory, config: ExperimentConfig) -> bool:
    done = directory.read_json("DONE")
    return (
        done is not None
        and (done.get("version", 0) == RUN_VERSION or config.force)
        and config.budget.is_spent(done["costs"])
        and done["evaluation"] == dataclasses.asdict(config.evaluation)
    )


def _train(
    directory: RunDirectory,
    config: ExperimentConfig,
    training: Training,
    faults: FaultFiles,
    signals: StopSignals,
) -> tuple[dict[str, Any], KeptPolicies | None]:
    """What the run has cost in the end, and the policies that it has kept."""
    learner = training.agent.learner
    updates = () if learner is None else learner.updates
    table = MetricsTable(directory.metrics, columns_of(updates))

    def save(step: int) -> None:
        # First what a run that goes on from this checkpoint will not write again.
        flush_to_disk(directory.metrics)
        logger: Any = monitor.logger
        if logger is not None:
            logger.experiment.flush()
        checkpoints.save(step)

    with contextlib.ExitStack() as stack:
        monitor = RunMonitor(
            training.watch,
            training.evolution,
            config.budget,
            table,
            save=save,
            save_interval_s=config.checkpoint.interval_s,
            faults=faults,
            updates=updates,
            signals=signals,
        )
        kept = _kept_policies(config, training, monitor)
        if kept is not None:
            kept.register(training.loop)
        monitor.register(training.loop)
        state = TrainingState(training, monitor, kept)
        checkpoints = Checkpoints(
            directory.checkpoints,
            state,
            {"configuration": run_key(config), "seed": config.seed},
            keep=config.checkpoint.keep,
        )
        try:
            if checkpoints.load_latest():
                _logger.info("going on at %d steps", monitor.total_steps)
        except CheckpointError as error:
            raise RunDirectoryError(str(error)) from error
        table.cut_after(monitor.total_steps)
        monitor.logger = _make_logger(directory, config, stack, monitor.total_steps)
        if not signals.received and not config.budget.is_spent(monitor.counters()):
            monitor.start()
            stack.callback(monitor.stop)
            training.loop.train()
        if signals.received:
            raise StoppedError
    return monitor.counters(), kept


def _kept_policies(
    config: ExperimentConfig, training: Training, monitor: RunMonitor
) -> KeptPolicies | None:
    count, budget = config.evaluation.num_policies, config.budget.total_steps
    if not count or budget is None:
        return None
    evolution = training.evolution
    return KeptPolicies(
        count,
        budget,
        training.agent.actor,
        lambda: monitor.counters() | {"agent_episodes": training.watch.episodes_completed},
        (lambda: None) if evolution is None else evolution.final_genome,
    )
