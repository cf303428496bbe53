"""One run from start to end: train or go on, evaluate, draw."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import logging
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torchrl.checkpoint import CheckpointError
from torchrl.record.loggers import Logger

from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.evolution.genome import install
from gdrl_torchrl.safe_files import own_folder
from gdrl_torchrl.training.build import Training, build_training, make_task_of
from gdrl_torchrl.training.checkpoint import (
    Checkpoints,
    TrainingState,
    flush_to_disk,
    is_out_of_memory,
    saved_checkpoints,
    seed_everything,
)
from gdrl_torchrl.training.evaluate import (
    evaluate_policy,
    evaluation_record,
    greedy_act,
    held_out_seeds,
    params_sha256,
    save_policy,
)
from gdrl_torchrl.training.faults import FaultFiles
from gdrl_torchrl.training.monitor import COLUMNS, RunMonitor, is_spent
from gdrl_torchrl.training.run_directory import (
    MetricsTable,
    RunDirectory,
    RunDirectoryError,
    code_version,
    run_key,
)
from gdrl_torchrl.training.update import NonFiniteUpdateError
from gdrl_torchrl.training.video import (
    record_trajectories,
    save_trajectories,
    write_video,
)
from gdrl_torchrl.training.worker import WorkerDiedError

_logger = logging.getLogger(__name__)
_TRAJECTORIES_DRAWN = 60
_FULL = (errno.ENOSPC, errno.EDQUOT)
_OF_THE_DISK = (
    *_FULL,
    *(errno.EACCES, errno.EIO, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG),
    errno.ENOTDIR,
    *(errno.EPERM, errno.EROFS),
)


class InterruptedRunError(RuntimeError):
    """A signal ended training; the run was saved and can be resumed.

    Attributes:
        signal: The signal.
        path: The run directory.
    """

    def __init__(self, number: signal.Signals, path: Path) -> None:
        super().__init__(
            f"stopped by {number.name} and saved: the same command goes on with {path}"
        )
        self.signal = number
        self.path = path


class TrainingDivergedError(RuntimeError):
    """A loss, a gradient or a parameter was not finite, and training was ended there.

    Attributes:
        path: The run directory.
        batch: File with the minibatch, if one was written.
        checkpoint: The last checkpoint, from before; None if there was none yet.
    """

    def __init__(
        self, error: NonFiniteUpdateError, directory: RunDirectory, batch: Path | None
    ) -> None:
        saved = saved_checkpoints(directory.checkpoints)
        self.path, self.batch = directory.path, batch
        self.checkpoint = saved[-1] if saved else None
        super().__init__(
            f"{directory.path}: {error}; minibatch: {batch or 'not kept'}; last good "
            f"checkpoint: {self.checkpoint or 'none yet'}. The same command goes on from "
            "there; faults.on_non_finite_update=skip makes no such updates"
        )


def run_experiment(config: ExperimentConfig) -> Path:
    """Bring a run to its end and return its directory.

    A run that is complete under this configuration is returned as it is; one that was
    begun goes on from its last checkpoint.

    Raises:
        ValueError: If the configuration is not valid.
        RunDirectoryError: If the directory cannot be used, or the disk is full.
        InterruptedRunError: If a signal stopped training.
        TrainingDivergedError: If something in an update was not finite.
        WorkerDiedError: If a process that collects was killed.
    """
    # What is wrong is said before anything is written.
    make_task_of(config)
    directory = RunDirectory.of(config)
    with _disk_errors_named(directory.path), directory.locked():
        if _is_complete(directory, config):
            _logger.info("already complete: %s", directory.path)
            return directory.path
        directory.open(config)
        directory.done.unlink(missing_ok=True)
        directory.failed.unlink(missing_ok=True)
        try:
            costs = _run(directory, config)
        except InterruptedRunError:
            raise
        except Exception as error:
            # On a full disk this fails as well, and must not hide the error.
            with contextlib.suppress(OSError):
                directory.write_json(
                    "FAILED", {"error": f"{type(error).__name__}: {error}"}
                )
            raise
        directory.write_json(
            "DONE",
            {
                "code": code_version(),
                "costs": costs,
                "evaluation": dataclasses.asdict(config.evaluation),
            },
        )
    return directory.path


@contextlib.contextmanager
def _disk_errors_named(path: Path) -> Iterator[None]:
    """Let errors of the disk say which run they are about, and what to do."""
    try:
        yield
    except OSError as error:
        if error.errno not in _OF_THE_DISK:
            raise
        advice = ""
        if error.errno in _FULL:
            advice = (
                "; checkpoints that were saved are whole: free some space, and the same "
                "command goes on from them"
            )
        raise RunDirectoryError(f"{path}: {error}{advice}") from error
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise RunDirectoryError(
            f"{path}: there is not enough memory ({error or 'for what came next'}); "
            "checkpoints that were saved are whole: the same command goes on from them"
        ) from error


def _run(directory: RunDirectory, config: ExperimentConfig) -> dict[str, Any]:
    seed_everything(config.seed)
    faults = FaultFiles(directory.path, config)
    training = build_training(config, on_divergence=faults.note_world)
    try:
        costs = _train(directory, config, training, faults)
        _report(directory, config, training, faults, costs)
    except NonFiniteUpdateError as error:
        batch = faults.note_update(error)
        raise TrainingDivergedError(error, directory, batch) from error
    except WorkerDiedError as error:
        raise WorkerDiedError(
            f"{directory.path}: {error}. The same command goes on from the last checkpoint"
        ) from error
    finally:
        training.close()
    return costs


def _is_complete(directory: RunDirectory, config: ExperimentConfig) -> bool:
    done = directory.read_json("DONE")
    return (
        done is not None
        and (done["code"] == code_version() or config.force)
        and is_spent(config.budget, done["costs"])
        and done["evaluation"] == dataclasses.asdict(config.evaluation)
    )


def _train(
    directory: RunDirectory,
    config: ExperimentConfig,
    training: Training,
    faults: FaultFiles,
) -> dict[str, Any]:
    table = MetricsTable(directory.metrics, COLUMNS)

    def save(step: int) -> None:
        # First what a run that goes on from this checkpoint will not write again.
        flush_to_disk(directory.metrics)
        logger: Any = monitor.logger
        if logger is not None:
            logger.experiment.flush()
        checkpoints.save(step)

    with contextlib.ExitStack() as stack:
        monitor = RunMonitor(
            training.genetic,
            config.budget,
            table,
            save=save,
            save_interval_s=config.checkpoint.interval_s,
            faults=faults,
            updates=training.agent.updates,
        )
        monitor.register(training.agent.trainer)
        state = TrainingState(training, monitor)
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
        if not is_spent(config.budget, monitor.counters()):
            monitor.start()
            stack.callback(monitor.stop)
            training.agent.trainer.train()
        costs = monitor.counters()
        if monitor.interrupted_by is not None and not is_spent(config.budget, costs):
            raise InterruptedRunError(monitor.interrupted_by, directory.path)
    return costs


def _make_logger(
    directory: RunDirectory,
    config: ExperimentConfig,
    stack: contextlib.ExitStack,
    total_steps: int,
) -> Logger | None:
    if not config.logger.tensorboard:
        return None
    # Imported here because tensorboard takes a while to import.
    from gdrl_torchrl.training.tensorboard import ResumedTensorboardLogger

    logger = ResumedTensorboardLogger(directory.path, total_steps)
    stack.callback(logger.experiment.close)
    return logger


def _report(
    directory: RunDirectory,
    config: ExperimentConfig,
    training: Training,
    faults: FaultFiles,
    costs: dict[str, Any],
) -> None:
    """Held-out evaluation, figures, video and the policy itself."""
    # Imported here because matplotlib takes a second to import.
    from gdrl_torchrl.analysis.figures import draw_learning_curve, draw_trajectories

    task, actor = training.task, training.agent.actor
    result = training.genetic.final_genome()
    if result is not None:
        install(actor, result)
    threads = config.simulation.num_threads
    scores = evaluate_policy(
        task,
        actor,
        config.evaluation,
        backend=config.task.backend,
        num_threads=threads,
        on_divergence=faults.note_world,
    )
    record = evaluation_record(config, scores, costs, params_sha256(actor))
    directory.write_json("evaluation.json", record)
    _logger.info(
        "held-out success %.3f over %d episodes", scores["success_rate"], scores["episodes"]
    )
    save_policy(directory.path / "final", actor, task, config)
    seeds = held_out_seeds(config.evaluation)
    act = greedy_act(actor)
    trajectories = record_trajectories(
        task, act, seeds[:_TRAJECTORIES_DRAWN], num_threads=threads
    )
    save_trajectories(directory.path, trajectories)
    draw_learning_curve(directory.path)
    draw_trajectories(directory.path)
    if config.logger.video_episodes:
        video = directory.path / "videos" / "episodes.mp4"
        own_folder(video.parent)
        how = write_video(task, act, seeds[: config.logger.video_episodes], video)
        _logger.info("video %s: %s", how, video)
