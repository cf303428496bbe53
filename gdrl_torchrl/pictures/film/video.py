"""Record episodes of a policy, and make a video of them with or without OpenGL."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from gdrl_tasks.task import NavigationTask
from gdrl_torchrl.files.safe_files import new_aside
from gdrl_torchrl.pictures.film.episodes import Act, record_trajectories
from gdrl_torchrl.pictures.film.frames import (
    Film,
    drawn_frames,
    rendered_frames,
)
from gdrl_torchrl.pictures.film.gl_backend import find_gl_backend

_logger = logging.getLogger(__name__)


TRAJECTORIES_FILE = "trajectories.npz"


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


def _encode(
    film: Film,
    pictures: Iterator[np.ndarray],
    path: Path,
    progress: Callable[[int, int], object] | None,
) -> None:
    """Put captions under the pictures and write them as H.264."""
    import imageio.v2 as imageio

    from gdrl_torchrl.pictures.captions import Captions

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
