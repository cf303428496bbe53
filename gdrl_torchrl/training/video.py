"""Record episodes of a policy, and make a video of them with or without OpenGL."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from gdrl_tasks.batch import BatchSimulation
from gdrl_tasks.indoor.lidar import beam_angles
from gdrl_tasks.indoor.robot import BODY_X_M, FOOTPRINT_M
from gdrl_tasks.indoor.task import IndoorTask
from gdrl_tasks.navigation import Outcome
from gdrl_tasks.task import NavigationTask
from gdrl_torchrl.safe_files import new_aside, written_aside
from gdrl_torchrl.training.frames import (
    Film,
    drawn_frames,
    rendered_frames,
    surface_of,
)
from gdrl_torchrl.training.gl_backend import find_gl_backend

_logger = logging.getLogger(__name__)

Act = Callable[[np.ndarray], np.ndarray]
"""Actions ``[K, A]`` or ``[K]`` for flat observations ``[K, D]`` of the live worlds."""

TRAJECTORIES_FILE = "trajectories.npz"
_SEA_SAMPLES = 400
_SEA_MARGIN_M = 2.0
_OUTLINE_CORNERS = 48


def record_trajectories(
    task: NavigationTask,
    act: Act,
    seeds: Sequence[int] | np.ndarray,
    *,
    num_threads: int = 0,
    scans: bool = False,
) -> dict[str, np.ndarray]:
    """Run one episode per seed and keep where the vehicles went.

    Args:
        task: The task.
        act: The policy. It is given the worlds whose episode goes on, in order.
        seeds: Episode seeds ``[K]``.
        num_threads: Threads of the simulation; 0 takes one per allowed processor.
        scans: Whether to keep what a lidar reported.

    Returns:
        Arrays by name; ``T`` is the longest episode's number of steps, rows after the
        end of an episode are NaN (zero in ``action``):

        - ``position`` (m) ``[T + 1, K, 2]``, ``heading`` (rad) ``[T + 1, K]``,
          ``action`` ``[T, K, A]`` or ``[T, K]``;
        - ``goal`` (m) ``[K, 2]``, ``outcome`` and ``steps`` ``[K]``, ``episode_seed``
          ``[K]``, ``outcome_names`` by outcome;
        - ``tolerance`` (m), ``control_interval_s``;
        - of a task with waves, the surface of the first episode as it begins:
          ``sea_x`` ``[N]``, ``sea_y`` ``[N]``, ``sea_elevation`` ``[N, N]`` (m);
        - of a task with walls and obstacles: their places ``obstacles`` ``[K, N, 4]``
          (x and y in m, cosine and sine of the yaw; the unused are 50 m away or more),
          ``obstacle_is_box`` ``[N]`` (others are cylinders), ``obstacle_half_size`` (m)
          ``[N, 2]``; half the arena's length and width inside the walls,
          ``half_extent`` (m) ``[2]``; and the vehicle in its own frame, ahead is +x,
          ``vehicle_outline`` (m) ``[P, 2]``;
        - of its lidar, in the outline's middle, ``beam_angles`` (rad from straight ahead)
          ``[B]`` and, with ``scans``, ``scan`` (m) ``[T + 1, K, B]``.

    Raises:
        ValueError: If there is no seed.
    """
    seeds = np.asarray(seeds, dtype=np.int64)
    if seeds.size == 0:
        raise ValueError("seeds=[] must name at least one episode")
    worlds = BatchSimulation(task, len(seeds), num_threads=num_threads)
    try:
        recorded = _run_episodes(worlds, act, seeds, scans=scans)
    finally:
        worlds.close()
    recorded |= {
        "goal": worlds.arrays["goal"].copy(),
        "outcome": worlds.arrays["outcome"].copy(),
        "steps": worlds.arrays["steps"].copy(),
        "episode_seed": seeds,
        "outcome_names": np.array([outcome.name.lower() for outcome in Outcome]),
        "tolerance": np.array(task.goal_tolerance_m),
        "control_interval_s": np.array(task.spec.control_interval_s),
    }
    if isinstance(task, IndoorTask):
        recorded |= _arena_of(task, worlds)
    surface = surface_of(task, int(seeds[0]))
    if surface is not None:
        places = np.concatenate([recorded["goal"], recorded["position"].reshape(-1, 2)])
        reach = float(np.nanmax(np.abs(places))) + _SEA_MARGIN_M
        reach = min(reach, 2.0 * np.abs(recorded["goal"]).max() + _SEA_MARGIN_M)
        side = np.linspace(-reach, reach, _SEA_SAMPLES)
        recorded |= {"sea_x": side, "sea_y": side}
        recorded["sea_elevation"] = surface(side, side, 0.0).astype(np.float32)
    return recorded


def save_trajectories(run_dir: str | Path, trajectories: dict[str, np.ndarray]) -> Path:
    """Write ``trajectories.npz`` into a run directory.

    Args:
        run_dir: Directory of the run.
        trajectories: Arrays of :func:`record_trajectories`.

    Returns:
        The file written.
    """
    path = Path(run_dir) / TRAJECTORIES_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path) as aside:
        np.savez_compressed(aside, allow_pickle=False, **trajectories)
    return path


def write_video(
    task: NavigationTask,
    act: Act,
    seeds: Sequence[int] | np.ndarray,
    path: str | Path,
    *,
    fps: int = 25,
    height: int = 360,
    width: int = 480,
    max_frames: int = 150,
    progress: Callable[[int, int], object] | None = None,
) -> Literal["rendered", "drawn"]:
    """Write an mp4 of episodes one after another, from above and from behind.

    The episodes are run first; then their actions are replayed in the task's dm_control
    environment and rendered. Where no OpenGL backend works, they are drawn from above
    with matplotlib, and the log says so.

    Args:
        task: The task; its model has the cameras ``top`` and ``chase``.
        act: The policy, as in :func:`record_trajectories`.
        seeds: Episode seeds ``[K]``.
        path: The file to write.
        fps: Frames per second of the video.
        height: Height of each of the two views, pixels.
        width: Width of each of the two views, pixels.
        max_frames: The video runs in real time or, to be no longer than this (each
            episode's last second, which stands still, not counted), twice, three times,
            ... as fast.
        progress: Called after every frame with how many there are, and will be.

    Returns:
        Whether the frames were ``rendered`` or ``drawn``.

    Raises:
        ValueError: If there is no seed, a size is not an even number above zero, or
            ``fps`` or ``max_frames`` is below 1.
    """
    for name, value in (("fps", fps), ("max_frames", max_frames)):
        if value < 1:
            raise ValueError(f"{name}={value} must be at least 1")
    for name, value in (("height", height), ("width", width)):
        if value < 2 or value % 2:
            raise ValueError(f"{name}={value} must be even and > 0")
    trajectories = record_trajectories(task, act, seeds, scans=True)
    film = Film.of(trajectories, fps=fps, height=height, width=width, max_frames=max_frames)
    backend, reason = find_gl_backend()
    why = "no GL backend"
    if backend is not None:
        os.environ.setdefault("MUJOCO_GL", backend)
        try:
            _encode(film, rendered_frames(task, film), Path(path), progress)
        except Exception as error:  # what a driver can raise has no common type
            why, reason = "rendering failed", repr(error)
        else:
            return "rendered"
    _logger.warning("%s: drawn from above with matplotlib (%s)", why, reason)
    _encode(film, drawn_frames(task, film), Path(path), progress)
    return "drawn"


def _run_episodes(
    worlds: BatchSimulation, act: Act, seeds: np.ndarray, *, scans: bool
) -> dict[str, np.ndarray]:
    """Positions, headings, actions and scans of whole episodes, cut to the longest."""
    count, limit = len(seeds), worlds.task.spec.step_limit
    position = np.full((limit + 1, count, 2), np.nan)
    heading = np.full((limit + 1, count), np.nan)
    observation = worlds.reset(seeds=seeds)
    position[0], heading[0] = worlds.task.planar_pose(worlds.qpos)
    scan = None
    if scans and "scan" in worlds.arrays:
        seen = worlds.arrays["scan"]
        scan = np.full((limit + 1, *seen.shape), np.nan, dtype=np.float32)
        scan[0] = seen
    alive, actions = np.arange(count), []
    while len(alive):
        chosen = np.asarray(act(observation[alive]))
        action = np.zeros((count, *chosen.shape[1:]), chosen.dtype)
        action[alive] = chosen
        actions.append(action)
        result = worlds.step(chosen, alive)
        # The arrays keep the last position to be believed of a world that diverged.
        position[len(actions), alive] = worlds.arrays["position"][alive]
        heading[len(actions), alive] = worlds.task.planar_pose(worlds.qpos[alive])[1]
        if scan is not None:
            scan[len(actions), alive] = worlds.arrays["scan"][alive]
        observation[alive] = result.observation
        alive = alive[~(result.terminated | result.truncated)]
    steps = len(actions)
    recorded = {
        "position": position[: steps + 1],
        "heading": heading[: steps + 1],
        "action": np.stack(actions),
    }
    if scan is not None:
        recorded["scan"] = scan[: steps + 1]
    return recorded


def _arena_of(task: IndoorTask, worlds: BatchSimulation) -> dict[str, np.ndarray]:
    """What stands in the way of the robot, its outline, and where its lidar looks."""
    shapes = task.arena.shapes
    around = np.linspace(0.0, 2.0 * np.pi, _OUTLINE_CORNERS, endpoint=False)
    circle = np.stack([np.cos(around), np.sin(around)], axis=-1)
    options = task.options
    return {
        "obstacles": worlds.arrays["obstacles"].copy(),
        "obstacle_is_box": shapes.is_box,
        "obstacle_half_size": shapes.half_size,
        "half_extent": np.array(task.arena.half_extent_m),
        "vehicle_outline": FOOTPRINT_M * circle + [BODY_X_M, 0.0],
        "beam_angles": beam_angles(options.num_beams, options.field_of_view_deg),
    }


def _encode(
    film: Film,
    pictures: Iterator[np.ndarray],
    path: Path,
    progress: Callable[[int, int], object] | None,
) -> None:
    """Put captions under the pictures and write them as H.264."""
    import imageio.v2 as imageio

    from gdrl_torchrl.analysis.captions import Captions

    path.parent.mkdir(parents=True, exist_ok=True)
    partial = new_aside(path)
    captions = Captions(film.trajectories, film.speed, 2 * film.width)
    writer = imageio.get_writer(
        partial,
        format="FFMPEG",  # pyright: ignore[reportArgumentType]
        fps=film.fps,
        codec="libx264",
        pixelformat="yuv420p",
        macro_block_size=2,
        quality=6,
        # Half the time of the default, and files a fifth larger.
        output_params=["-preset", "veryfast"],
        ffmpeg_log_level="error",
    )
    written = 0
    try:
        with writer:
            for episode in range(film.num_episodes):
                moments = film.moments(episode).tolist()
                for number, moment in enumerate(moments, start=1):
                    frame = captions.under(next(pictures), episode, moment)
                    for _ in range(1 + film.hold * (number == len(moments))):
                        writer.append_data(frame)
                        written += 1
                    if progress is not None:
                        progress(written, film.num_frames)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
