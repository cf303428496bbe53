"""The end of a run: held-out evaluation, figures, video and the policy itself."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Iterator
from typing import Any

from torchrl.record.loggers import Logger

from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.evolution.operators.genome import install
from gdrl_torchrl.files.directory import RunDirectory
from gdrl_torchrl.files.evaluation import CURVE_FILE
from gdrl_torchrl.files.faults import FaultFiles
from gdrl_torchrl.files.policy import params_sha256, save_policy
from gdrl_torchrl.files.safe_files import own_folder
from gdrl_torchrl.files.trajectories import save_trajectories
from gdrl_torchrl.pictures.film.episodes import record_trajectories
from gdrl_torchrl.pictures.film.video import write_video
from gdrl_torchrl.runs.build import Training
from gdrl_torchrl.runs.evaluate import (
    evaluate_kept,
    evaluate_policy,
    evaluation_record,
    greedy_act,
    held_out_seeds,
)
from gdrl_torchrl.runs.kept_policies import KeptPolicies

_logger = logging.getLogger(__name__)


_TRAJECTORIES_DRAWN = 60


def _make_logger(
    directory: RunDirectory,
    config: ExperimentConfig,
    stack: contextlib.ExitStack,
    total_steps: int,
) -> Logger | None:
    if not config.logger.tensorboard:
        return None
    # Imported here because tensorboard takes a while to import.
    from gdrl_torchrl.runs.tensorboard import ResumedTensorboardLogger

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


def report_run(
    directory: RunDirectory,
    config: ExperimentConfig,
    training: Training,
    faults: FaultFiles,
    costs: dict[str, Any],
    kept: KeptPolicies | None = None,
) -> None:
    """Held-out evaluation, of kept policies too; figures, video and the policy itself."""
    task, actor = training.task, training.agent.actor
    result = training.evolution and training.evolution.final_genome()
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
    if kept is not None and kept.points:
        points = evaluate_kept(task, actor, kept, config, on_divergence=faults.note_world)
        directory.write_json(CURVE_FILE, {"points": points})
    save_policy(directory.path / "final", actor, task, config.algorithm_label)
    seeds = held_out_seeds(config.evaluation)
    act = greedy_act(actor)
    trajectories = record_trajectories(
        task, act, seeds[:_TRAJECTORIES_DRAWN], num_threads=threads
    )
    save_trajectories(directory.path, trajectories)
    if config.logger.figures:
        # Imported here because matplotlib takes a second to import.
        from gdrl_torchrl.pictures.figures import draw_learning_curve, draw_trajectories

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
