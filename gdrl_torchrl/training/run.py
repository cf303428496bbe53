"""One run from start to end: train or go on, evaluate, draw."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import logging
import signal
from pathlib import Path
from typing import Any

from torchrl.checkpoint import CheckpointError
from torchrl.record.loggers import Logger

from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.evolution.genome import install
from gdrl_torchrl.training.build import Training, build_training, make_task_of
from gdrl_torchrl.training.checkpoint import (
    Checkpoints,
    TrainingState,
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
from gdrl_torchrl.training.monitor import COLUMNS, RunMonitor, is_spent
from gdrl_torchrl.training.run_directory import (
    MetricsTable,
    RunDirectory,
    RunDirectoryError,
    code_version,
    run_key,
)
from gdrl_torchrl.training.video import (
    record_trajectories,
    save_trajectories,
    write_video,
)

_logger = logging.getLogger(__name__)
_TRAJECTORIES_DRAWN = 60
_FULL = (errno.ENOSPC, errno.EDQUOT)


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


def run_experiment(config: ExperimentConfig) -> Path:
    """Bring a run to its end and return its directory.

    A run that is complete under this configuration is returned as it is; one that was
    begun goes on from its last checkpoint.

    Raises:
        ValueError: If the configuration is not valid.
        RunDirectoryError: If the directory cannot be used, or the disk is full.
        InterruptedRunError: If a signal stopped training.
    """
    # What is wrong is said before anything is written.
    make_task_of(config)
    directory = RunDirectory.of(config)
    with directory.locked():
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
            if isinstance(error, OSError) and error.errno in _FULL:
                raise RunDirectoryError(
                    f"{directory.path}: {error}; the checkpoints before are whole: free "
                    "some space, and the same command goes on from them"
                ) from error
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


def _run(directory: RunDirectory, config: ExperimentConfig) -> dict[str, Any]:
    seed_everything(config.seed)
    training = build_training(config)
    try:
        costs = _train(directory, config, training)
        _report(directory, config, training, costs)
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
    directory: RunDirectory, config: ExperimentConfig, training: Training
) -> dict[str, Any]:
    table = MetricsTable(directory.metrics, COLUMNS)
    with contextlib.ExitStack() as stack:
        logger = _make_logger(directory, config, stack)
        monitor = RunMonitor(
            training.genetic,
            config.budget,
            table,
            save=lambda step: checkpoints.save(step),
            save_interval_s=config.checkpoint.interval_s,
            logger=logger,
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
        if not is_spent(config.budget, monitor.counters()):
            monitor.start()
            stack.callback(monitor.stop)
            training.agent.trainer.train()
        costs = monitor.counters()
        if monitor.interrupted_by is not None and not is_spent(config.budget, costs):
            raise InterruptedRunError(monitor.interrupted_by, directory.path)
    return costs


def _make_logger(
    directory: RunDirectory, config: ExperimentConfig, stack: contextlib.ExitStack
) -> Logger | None:
    if not config.logger.tensorboard:
        return None
    # Imported here because tensorboard takes a second to import.
    from torchrl.record.loggers.tensorboard import TensorboardLogger

    logger = TensorboardLogger("tensorboard", log_dir=str(directory.path))
    stack.callback(logger.experiment.close)
    return logger


def _report(
    directory: RunDirectory,
    config: ExperimentConfig,
    training: Training,
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
        how = write_video(task, act, seeds[: config.logger.video_episodes], video)
        _logger.info("video %s: %s", how, video)
