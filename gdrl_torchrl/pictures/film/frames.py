"""Pictures of recorded episodes: rendered from their replay, or drawn from above."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np

from gdrl_tasks.engines.scenery import draw_faster
from gdrl_tasks.task import NavigationTask
from gdrl_tasks.water.scenery import surface_grid
from gdrl_tasks.water.waves import SEA_FIELDS

_HOLD_S = 1.0
"""How long an episode's last frame stays, in the video's time."""


@dataclasses.dataclass(frozen=True)
class Film:
    """What is shown of recorded episodes, how large and how fast."""

    trajectories: dict[str, np.ndarray]
    speed: int
    """Simulated over shown seconds."""
    fps: int
    height: int
    width: int

    @classmethod
    def of(
        cls,
        trajectories: dict[str, np.ndarray],
        *,
        fps: int,
        height: int,
        width: int,
        max_frames: int,
    ) -> Film:
        """The film of arguments of :func:`gdrl_torchrl.pictures.film.video.write_video`."""
        interval = float(trajectories["control_interval_s"])
        shown_s = int(trajectories["steps"].sum()) * interval
        speed = max(1, math.ceil(shown_s * fps / max(1, max_frames) - 1e-9))
        return cls(trajectories, speed, fps, height, width)

    @property
    def num_episodes(self) -> int:
        """Number of recorded episodes."""
        return len(self.trajectories["steps"])

    def moments(self, episode: int) -> np.ndarray:
        """When there is a frame, in control steps; the last one always has one."""
        last = int(self.trajectories["steps"][episode])
        apart = self.speed / (self.fps * float(self.trajectories["control_interval_s"]))
        moments = apart * np.arange(math.ceil(last / apart - 1e-6))
        # Those of a control step are its own, not one just beside it.
        whole = moments.round()
        moments = np.where(np.abs(moments - whole) < 1e-6, whole, moments)
        return np.append(moments, last)

    @property
    def hold(self) -> int:
        """How often an episode's last frame is repeated."""
        return round(_HOLD_S * self.fps)

    @property
    def num_frames(self) -> int:
        """Frames of the whole video."""
        shown = sum(len(self.moments(k)) for k in range(self.num_episodes))
        return shown + self.num_episodes * self.hold


def rendered_frames(task: NavigationTask, film: Film) -> Iterator[np.ndarray]:
    """Replay the recorded actions and render what the two cameras see."""
    for shown in replayed_moments(task, film, prepare=draw_faster):
        yield _render(shown.physics, film.height, film.width)


def replayed_moments(
    task: NavigationTask, film: Film, *, prepare: Callable[[Any], object]
) -> Iterator[Any]:
    """Replay the recorded actions; an environment as it was at each moment of a film.

    Between control steps there are the states of the substeps, and between those what
    lies between. One environment replays, another one is posed and rendered: nothing
    that is shown can change what happens.

    Args:
        task: The task.
        film: What is shown.
        prepare: Called with the physics that is shown before it has rendered anything.
    """
    # tensordict loads Triton, which ends the process if it is loaded after Mesa's
    # software driver.
    import tensordict  # noqa: F401

    from gdrl_tasks.engines.dm_env import make_environment

    played, shown = make_environment(task), make_environment(task)
    # Smoothed edges alone would take half of the time where the processor renders.
    prepare(shown.physics)
    try:
        for episode in range(film.num_episodes):
            seed = int(film.trajectories["episode_seed"][episode])
            for environment in (played, shown):
                suite_task: Any = environment.task
                suite_task.next_episode_seed = seed
            steps = int(film.trajectories["steps"][episode])
            replay = replay_of(played, film.trajectories["action"][:steps, episode])
            shown.reset()
            for moment in film.moments(episode):
                pose(shown, replay, float(moment))
                yield shown
    finally:
        played.close()
        shown.close()


@dataclasses.dataclass(frozen=True)
class Replay:
    """States of an episode after every substep, and the task's arrays after every step."""

    time_s: np.ndarray
    qpos: np.ndarray
    num_substeps: int
    arrays: list[dict[str, np.ndarray]]


def replay_of(environment: Any, actions: np.ndarray) -> Replay:
    """Run an episode of a dm_control environment and note all of its states."""
    physics, task = environment.physics, environment.task
    timestep = environment.reset()
    states = [(physics.data.time, physics.data.qpos.copy())]
    arrays = [{name: value.copy() for name, value in task.arrays.items()}]
    step, num_substeps = physics.step, task.task.spec.num_substeps

    def step_and_note(nstep: int = 1) -> None:
        for _ in range(nstep):
            step(1)
            states.append((physics.data.time, physics.data.qpos.copy()))

    physics.step = step_and_note
    try:
        for action in actions:
            # An ended environment would begin a new episode at the next step.
            if timestep.last():
                break
            timestep = environment.step(action)
            arrays.append({name: value.copy() for name, value in task.arrays.items()})
    finally:
        del physics.step
    time_s, qpos = zip(*states, strict=True)
    return Replay(np.array(time_s), np.array(qpos), num_substeps, arrays)


def pose(environment: Any, replay: Replay, moment: float) -> None:
    """Put an environment where a replayed one was at a moment, in control steps."""
    physics = environment.physics
    model, data = physics.model.ptr, physics.data.ptr
    substep = min(moment * replay.num_substeps, len(replay.qpos) - 1)
    before = math.floor(substep + 1e-6)
    share = max(0.0, substep - before)
    qpos, time_s = replay.qpos[before].copy(), replay.time_s[before]
    if share > 1e-6:
        change = np.zeros(model.nv)
        after = replay.qpos[before + 1]
        mujoco.mj_differentiatePos(model, change, 1.0, qpos, after)
        mujoco.mj_integratePos(model, qpos, change, share)
        time_s += share * (replay.time_s[before + 1] - time_s)
    data.qpos[:], data.time = qpos, time_s
    now = replay.arrays[min(math.floor(moment), len(replay.arrays) - 1)]
    for name, value in environment.task.arrays.items():
        value[...] = now[name]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


def _render(physics: Any, height: int, width: int) -> np.ndarray:
    """Both views side by side, ``[height, 2 width, 3]``."""
    casts = physics.model.light_castshadow
    light, casts[:] = casts.copy(), False
    try:
        # From far above, shadows show little and cost as much as all the rest.
        above = physics.render(height, width, camera_id="top")
    finally:
        casts[:] = light
    # The first view brought the scenery up to date.
    update, physics.before_render = physics.before_render, None
    try:
        behind = physics.render(height, width, camera_id="chase")
    finally:
        physics.before_render = update
    return np.concatenate([above, behind], axis=1)


def drawn_frames(task: NavigationTask, film: Film) -> Iterator[np.ndarray]:
    """Draw the recorded episodes from above."""
    from gdrl_torchrl.pictures.from_above import FromAbove
    from gdrl_torchrl.pictures.layout import Layout
    from gdrl_torchrl.pictures.trajectories import view_reach

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
        drawn, picture = -1, np.zeros(0)
        for step in np.floor(film.moments(episode)).astype(int).tolist():
            # Only what was recorded is drawn: the last control step.
            if step != drawn:
                ranges = None if scan is None else scan[step, episode]
                time_s = step * interval
                picture = view.draw(path[: step + 1], float(heading[step]), time_s, ranges)
                drawn = step
            yield picture


def surface_of(
    task: NavigationTask, seed: int
) -> Callable[[np.ndarray, np.ndarray, float], np.ndarray] | None:
    """Elevation of an episode's sea over a grid; None if the task has no waves."""
    arrays = task.draw_episode(seed).arrays
    if not all(name in arrays for name in SEA_FIELDS):
        return None
    sea = {name: np.asarray(arrays[name]) for name in SEA_FIELDS}
    return functools.partial(surface_grid, sea)
