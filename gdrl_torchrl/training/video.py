"""Record episodes of a policy, and make a video of them with or without OpenGL."""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gdrl_tasks.batch import BatchSimulation
from gdrl_tasks.navigation import Outcome
from gdrl_tasks.task import NavigationTask
from gdrl_tasks.water.scenery import surface_grid
from gdrl_tasks.water.waves import SEA_FIELDS
from gdrl_torchrl.training.gl_backend import find_gl_backend

_logger = logging.getLogger(__name__)

Act = Callable[[np.ndarray], np.ndarray]
"""Actions ``[K, A]`` or ``[K]`` for flat observations ``[K, D]`` of the live worlds."""

TRAJECTORIES_FILE = "trajectories.npz"
_SEA_SAMPLES = 400
_SEA_MARGIN_M = 2.0
_SPEED = 2.0
_SLOWEST_FPS, _FASTEST_FPS = 6, 30
_HOLD_S = 1.0
"""How long an episode's last frame stays, in the video's time."""


def record_trajectories(
    task: NavigationTask,
    act: Act,
    seeds: Sequence[int] | np.ndarray,
    *,
    num_threads: int = 0,
) -> dict[str, np.ndarray]:
    """Run one episode per seed and keep where the vehicles went.

    Args:
        task: The task.
        act: The policy. It is given the worlds whose episode goes on, in order.
        seeds: Episode seeds ``[K]``.
        num_threads: Threads of the simulation; 0 takes one per processor.

    Returns:
        Arrays by name; ``T`` is the longest episode's number of steps, rows after the
        end of an episode are NaN (zero in ``action``):

        - ``position`` (m) ``[T + 1, K, 2]``, ``heading`` (rad) ``[T + 1, K]``,
          ``action`` ``[T, K, A]`` or ``[T, K]``;
        - ``goal`` (m) ``[K, 2]``, ``outcome`` and ``steps`` ``[K]``, ``episode_seed``
          ``[K]``, ``outcome_names`` by outcome;
        - ``tolerance`` (m), ``control_interval_s``;
        - of a task with waves, the surface of the first episode as it begins:
          ``sea_x`` ``[N]``, ``sea_y`` ``[N]``, ``sea_elevation`` ``[N, N]`` (m).

    Raises:
        ValueError: If there is no seed.
    """
    seeds = np.asarray(seeds, dtype=np.int64)
    if seeds.size == 0:
        raise ValueError("seeds=[] must name at least one episode")
    worlds = BatchSimulation(task, len(seeds), num_threads=num_threads)
    try:
        recorded = _run_episodes(worlds, act, seeds)
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
    surface = _surface_of(task, int(seeds[0]))
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
    partial = path.with_name(f".{path.stem}.partial.npz")
    np.savez_compressed(partial, allow_pickle=False, **trajectories)
    partial.replace(path)
    return path


def write_video(
    task: NavigationTask,
    act: Act,
    seeds: Sequence[int] | np.ndarray,
    path: str | Path,
    *,
    fps: int | None = None,
    height: int = 360,
    width: int = 480,
    max_frames: int = 120,
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
        fps: Frames per second; None plays at twice real time where it can.
        height: Height of each of the two views, pixels.
        width: Width of each of the two views, pixels.
        max_frames: Above this many control steps in all, only every second (third,
            ...) is shown, and time runs faster.

    Returns:
        Whether the frames were ``rendered`` or ``drawn``.

    Raises:
        ValueError: If there is no seed, or a size is not an even number above zero.
    """
    for name, value in (("height", height), ("width", width)):
        if value < 2 or value % 2:
            raise ValueError(f"{name}={value} must be even and > 0")
    trajectories = record_trajectories(task, act, seeds)
    film = _Film.of(
        trajectories, fps=fps, height=height, width=width, max_frames=max_frames
    )
    backend, reason = find_gl_backend()
    why = "no GL backend"
    if backend is not None:
        os.environ.setdefault("MUJOCO_GL", backend)
        try:
            _encode(film, _rendered_frames(task, film), Path(path))
        except Exception as error:  # what a driver can raise has no common type
            why, reason = "rendering failed", repr(error)
        else:
            return "rendered"
    _logger.warning("%s: drawn from above with matplotlib (%s)", why, reason)
    _encode(film, _drawn_frames(task, film), Path(path))
    return "drawn"


@dataclasses.dataclass(frozen=True)
class _Film:
    """What is shown of recorded episodes, how large and how fast."""

    trajectories: dict[str, np.ndarray]
    stride: int
    """Control steps between frames."""
    fps: int
    height: int
    width: int

    @classmethod
    def of(
        cls,
        trajectories: dict[str, np.ndarray],
        *,
        fps: int | None,
        height: int,
        width: int,
        max_frames: int,
    ) -> _Film:
        interval = float(trajectories["control_interval_s"])
        stride = max(1, math.ceil(int(trajectories["steps"].sum()) / max(1, max_frames)))
        stride = max(stride, math.ceil(_SPEED / (interval * _FASTEST_FPS) - 1e-9))
        if fps is None:
            fps = max(_SLOWEST_FPS, round(_SPEED / (interval * stride)))
        return cls(trajectories, stride, fps, height, width)

    @property
    def num_episodes(self) -> int:
        return len(self.trajectories["steps"])

    @property
    def speed(self) -> float:
        """Simulated over shown seconds."""
        return self.fps * self.stride * float(self.trajectories["control_interval_s"])

    def steps_shown(self, episode: int) -> list[int]:
        """Control steps that have a frame; the last one always has."""
        last = int(self.trajectories["steps"][episode])
        return [*range(0, last, self.stride), last]

    @property
    def hold(self) -> int:
        """How often an episode's last frame is repeated."""
        return round(_HOLD_S * self.fps)

    @property
    def num_frames(self) -> int:
        shown = sum(len(self.steps_shown(k)) for k in range(self.num_episodes))
        return shown + self.num_episodes * self.hold


def _run_episodes(
    worlds: BatchSimulation, act: Act, seeds: np.ndarray
) -> dict[str, np.ndarray]:
    """Positions, headings and actions of whole episodes, cut to the longest."""
    count, limit = len(seeds), worlds.task.spec.step_limit
    position = np.full((limit + 1, count, 2), np.nan)
    heading = np.full((limit + 1, count), np.nan)
    observation = worlds.reset(seeds=seeds)
    position[0], heading[0] = worlds.task.planar_pose(worlds.qpos)
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
        observation[alive] = result.observation
        alive = alive[~(result.terminated | result.truncated)]
    steps = len(actions)
    return {
        "position": position[: steps + 1],
        "heading": heading[: steps + 1],
        "action": np.stack(actions),
    }


def _surface_of(
    task: NavigationTask, seed: int
) -> Callable[[np.ndarray, np.ndarray, float], np.ndarray] | None:
    """Elevation of an episode's sea over a grid; None if the task has no waves."""
    arrays = task.draw_episode(seed).arrays
    if not all(name in arrays for name in SEA_FIELDS):
        return None
    sea = {name: np.asarray(arrays[name]) for name in SEA_FIELDS}
    return functools.partial(surface_grid, sea)


def _rendered_frames(task: NavigationTask, film: _Film) -> Iterator[np.ndarray]:
    """Replay the recorded actions and render what the two cameras see."""
    # tensordict loads Triton, which ends the process if it is loaded after Mesa's
    # software driver.
    import tensordict  # noqa: F401

    from gdrl_tasks.dm_env import make_environment

    environment = make_environment(task)
    suite_task: Any = environment.task
    # Smoothed edges would take a third of the time where the processor renders.
    environment.physics.model.vis.quality.offsamples = 0
    try:
        for episode in range(film.num_episodes):
            actions = film.trajectories["action"][:, episode]
            suite_task.next_episode_seed = int(film.trajectories["episode_seed"][episode])
            timestep = environment.reset()
            step = 0
            for shown in film.steps_shown(episode):
                # An ended environment would begin a new episode at the next step.
                while step < shown and not timestep.last():
                    timestep = environment.step(actions[step])
                    step += 1
                yield _render(environment.physics, film.height, film.width)
    finally:
        environment.close()


def _render(physics: Any, height: int, width: int) -> np.ndarray:
    """Both views side by side, ``[height, 2 width, 3]``."""
    above = physics.render(height, width, camera_id="top")
    # The first view brought the scenery up to date, which costs more than rendering.
    update, physics.before_render = physics.before_render, None
    try:
        behind = physics.render(height, width, camera_id="chase")
    finally:
        physics.before_render = update
    return np.concatenate([above, behind], axis=1)


def _drawn_frames(task: NavigationTask, film: _Film) -> Iterator[np.ndarray]:
    """Draw the recorded episodes from above."""
    from gdrl_torchrl.analysis.figures import view_reach
    from gdrl_torchrl.analysis.from_above import FromAbove

    trajectories = film.trajectories
    for episode in range(film.num_episodes):
        seed = int(trajectories["episode_seed"][episode])
        surface = _surface_of(task, seed)
        arrays = task.draw_episode(seed).arrays
        view = FromAbove(
            goal=trajectories["goal"][episode],
            tolerance_m=float(trajectories["tolerance"]),
            reach_m=view_reach(trajectories),
            wave_height_m=float(arrays.get("significant_wave_height", 0.0)),
            surface=surface,
            height=film.height,
            width=film.width,
        )
        path = trajectories["position"][:, episode]
        heading = trajectories["heading"][:, episode]
        interval = float(trajectories["control_interval_s"])
        for shown in film.steps_shown(episode):
            yield view.draw(path[: shown + 1], heading[shown], shown * interval)


def _encode(film: _Film, pictures: Iterator[np.ndarray], path: Path) -> None:
    """Put captions under the pictures and write them as H.264."""
    import imageio.v2 as imageio

    from gdrl_torchrl.analysis.captions import Captions

    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial.mp4")
    captions = Captions(film.trajectories, film.speed, 2 * film.width)
    writer = imageio.get_writer(
        partial,
        format="FFMPEG",  # pyright: ignore[reportArgumentType]
        fps=film.fps,
        codec="libx264",
        pixelformat="yuv420p",
        macro_block_size=2,
        quality=7,
        ffmpeg_log_level="error",
    )
    try:
        with writer:
            for episode in range(film.num_episodes):
                shown = film.steps_shown(episode)
                for step in shown:
                    frame = captions.under(next(pictures), episode, step)
                    for _ in range(1 + film.hold * (step == shown[-1])):
                        writer.append_data(frame)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
