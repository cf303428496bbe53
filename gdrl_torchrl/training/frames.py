"""Pictures of recorded episodes: rendered from their replay, or drawn from above."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from gdrl_tasks.task import NavigationTask
from gdrl_tasks.water.scenery import surface_grid
from gdrl_tasks.water.waves import SEA_FIELDS

_SPEED = 2.0
_SLOWEST_FPS, _FASTEST_FPS = 6, 30
_HOLD_S = 1.0
"""How long an episode's last frame stays, in the video's time."""


@dataclasses.dataclass(frozen=True)
class Film:
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
    ) -> Film:
        """The film of arguments of :func:`gdrl_torchrl.training.video.write_video`."""
        interval = float(trajectories["control_interval_s"])
        stride = max(1, math.ceil(int(trajectories["steps"].sum()) / max(1, max_frames)))
        stride = max(stride, math.ceil(_SPEED / (interval * _FASTEST_FPS) - 1e-9))
        if fps is None:
            fps = max(_SLOWEST_FPS, round(_SPEED / (interval * stride)))
        return cls(trajectories, stride, fps, height, width)

    @property
    def num_episodes(self) -> int:
        """Number of recorded episodes."""
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
        """Frames of the whole video."""
        shown = sum(len(self.steps_shown(k)) for k in range(self.num_episodes))
        return shown + self.num_episodes * self.hold


def rendered_frames(task: NavigationTask, film: Film) -> Iterator[np.ndarray]:
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


def drawn_frames(task: NavigationTask, film: Film) -> Iterator[np.ndarray]:
    """Draw the recorded episodes from above."""
    from gdrl_torchrl.analysis.from_above import FromAbove
    from gdrl_torchrl.analysis.layout import Layout
    from gdrl_torchrl.analysis.trajectories import view_reach

    trajectories = film.trajectories
    scan = trajectories.get("scan")
    for episode in range(film.num_episodes):
        seed = int(trajectories["episode_seed"][episode])
        arrays = task.draw_episode(seed).arrays
        view = FromAbove(
            goal=trajectories["goal"][episode],
            tolerance_m=float(trajectories["tolerance"]),
            reach_m=view_reach(trajectories, film.width / film.height),
            wave_height_m=float(arrays.get("significant_wave_height", 0.0)),
            surface=surface_of(task, seed),
            layout=Layout.of(trajectories, episode),
            beam_angles=trajectories.get("beam_angles"),
            height=film.height,
            width=film.width,
        )
        path = trajectories["position"][:, episode]
        heading = trajectories["heading"][:, episode]
        interval = float(trajectories["control_interval_s"])
        for shown in film.steps_shown(episode):
            ranges = None if scan is None else scan[shown, episode]
            yield view.draw(path[: shown + 1], heading[shown], shown * interval, ranges)


def surface_of(
    task: NavigationTask, seed: int
) -> Callable[[np.ndarray, np.ndarray, float], np.ndarray] | None:
    """Elevation of an episode's sea over a grid; None if the task has no waves."""
    arrays = task.draw_episode(seed).arrays
    if not all(name in arrays for name in SEA_FIELDS):
        return None
    sea = {name: np.asarray(arrays[name]) for name in SEA_FIELDS}
    return functools.partial(surface_grid, sea)
