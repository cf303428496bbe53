"""One run from start to end: train or go on, evaluate, draw."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from torchrl.checkpoint import CheckpointError
from torchrl.record.loggers import Logger

from gdrl_torchrl.config.relations import make_task_of
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.evolution.genome import install
from gdrl_torchrl.safe_files import own_folder
from gdrl_torchrl.training.build import Training, build_training
from gdrl_torchrl.training.checkpoint import (
    Checkpoints,
    TrainingState,
    flush_to_disk,
    seed_everything,
)
from gdrl_torchrl.training.errors import (
    InterruptedRunError,
    TrainingDivergedError,
    system_errors_named,
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
from gdrl_torchrl.training.finite_batches import NonFiniteBatchError
from gdrl_torchrl.training.monitor import RunMonitor, columns_of, is_spent
from gdrl_torchrl.training.provenance import RUN_VERSION, code_version
from gdrl_torchrl.training.run_directory import (
    MetricsTable,
    RunDirectory,
    RunDirectoryError,
    run_key,
)
from gdrl_torchrl.training.signals import StoppedError, StopSignals
from gdrl_torchrl.training.update import NonFiniteUpdateError
from gdrl_torchrl.training.video import (
    record_trajectories,
    save_trajectories,
    write_video,
)
from gdrl_torchrl.training.worker import WorkerDiedError

_logger = logging.getLogger(__name__)
_TRAJECTORIES_DRAWN = 60


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
    directory = RunDirectory.of(config)
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
    directory.open(config, overrides)
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
    faults = FaultFiles(directory.path, config)
    training = build_training(config, on_divergence=faults.note_world)
    try:
        costs = _train(directory, config, training, faults, signals)
        with signals.ending_at_once():
            _report(directory, config, training, faults, costs)
    except (NonFiniteUpdateError, NonFiniteBatchError) as error:
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
        and (done.get("version", 0) == RUN_VERSION or config.force)
        and is_spent(config.budget, done["costs"])
        and done["evaluation"] == dataclasses.asdict(config.evaluation)
    )


def _train(
    directory: RunDirectory,
    config: ExperimentConfig,
    training: Training,
    faults: FaultFiles,
    signals: StopSignals,
) -> dict[str, Any]:
    table = MetricsTable(directory.metrics, columns_of(training.agent.updates))

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
            signals=signals,
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
        if not signals.received and not is_spent(config.budget, monitor.counters()):
            monitor.start()
            stack.callback(monitor.stop)
            training.agent.trainer.train()
        if signals.received:
            raise StoppedError
    return monitor.counters()


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
    logger.log_configuration(dataclasses.asdict(config), total_steps)
    return logger


def _show_result(
    directory: RunDirectory, config: ExperimentConfig, record: dict[str, Any]
) -> None:
    """Give the held-out result and the figures to TensorBoard."""
    step = int(record["total_steps"])
    with contextlib.ExitStack() as stack:
        logger: Any = _make_logger(directory, config, stack, step)
        if logger is None:
            return
        numbers = {n: record[n] for n in ("success_rate", "return_mean") if n in record}
        logger.log_metrics({f"held_out/{n}": x for n, x in numbers.items()}, step)
        for path in sorted((directory.path / "figures").glob("*.png")):
            logger.log_picture(f"figures/{path.stem}", path, step)


def _report(
    directory: RunDirectory,
    config: ExperimentConfig,
    training: Training,
    faults: FaultFiles,
    costs: dict[str, Any],
) -> None:
    """Held-out evaluation, figures, video and the policy itself."""
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
    # Imported here because matplotlib takes a second to import.
    from gdrl_torchrl.analysis.figures import draw_learning_curve, draw_trajectories

    with _nice_to_have("learning curve"):
        draw_learning_curve(directory.path)
    with _nice_to_have("trajectories"):
        draw_trajectories(directory.path)
    with _nice_to_have("result in TensorBoard"):
        _show_result(directory, config, record)
    if config.logger.video_episodes:
        video = directory.path / "videos" / "episodes.mp4"
        with _nice_to_have("video"):
            own_folder(video.parent)
            how = write_video(task, act, seeds[: config.logger.video_episodes], video)
            _logger.info("video %s: %s", how, video)


@contextlib.contextmanager
def _nice_to_have(picture: str) -> Iterator[None]:
    """A run is complete without pictures: whatever fails while one is made is told."""
    try:
        yield
    except Exception as error:
        _logger.warning(
            "no picture of the %s: %s: %s; the run is complete without it",
            picture,
            type(error).__name__,
            error,
        )
