"""Recorded episodes and their videos, with and without OpenGL."""

from __future__ import annotations

import itertools
import logging
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import mujoco
import numpy as np
import pytest

from gdrl_tasks import NavigationTask, Outcome, make_task
from gdrl_tasks.controllers import pursuit
from gdrl_tasks.engines.scenery import draw_faster
from gdrl_tasks.indoor.definition import clearance
from gdrl_tasks.indoor.robot import LIDAR_HEIGHT_M
from gdrl_torchrl.files.trajectories import read_trajectories, save_trajectories
from gdrl_torchrl.pictures.captions import caption_height
from gdrl_torchrl.pictures.film import frames as frames_of
from gdrl_torchrl.pictures.film import gl_backend, video
from gdrl_torchrl.pictures.film.episodes import record_trajectories
from gdrl_torchrl.pictures.film.video import write_video
from gdrl_torchrl.pictures.layout import posed

TASKS = ("water", "indoor")
SEEDS = [11, 12]
HEIGHT, WIDTH = 64, 96
COMMON = {
    "position",
    "heading",
    "action",
    "goal",
    "outcome",
    "steps",
    "episode_seed",
    "outcome_names",
    "tolerance",
    "control_interval_s",
}
SEA = {"sea_x", "sea_y", "sea_elevation"}
ARENA = {
    "obstacles",
    "obstacle_is_box",
    "obstacle_half_size",
    "half_extent",
    "vehicle_outline",
    "beam_angles",
}


def turn_to_goal(observation: np.ndarray) -> np.ndarray:
    """Turn rates of the indoor task that turn the robot to its goal, walls or not."""
    return np.clip(np.round(2.0 + 8.0 * observation[:, 1]), 0, 4).astype(np.int64)


CONTROLLERS = {"water": pursuit, "indoor": turn_to_goal}
DRIFTERS = {
    "water": lambda observation: np.zeros((len(observation), 2)),
    "indoor": lambda observation: np.full(len(observation), 2),
}


def drift(task: NavigationTask) -> video.Act:
    return DRIFTERS[task.name]


@pytest.fixture(params=TASKS)
def task(request: pytest.FixtureRequest) -> NavigationTask:
    return make_task(request.param)


@pytest.fixture(params=TASKS)
def short_task(request: pytest.FixtureRequest) -> NavigationTask:
    """Episodes of three control steps."""
    return make_task(request.param, step_limit=3)


def test_recorded_successes_end_at_their_goal(task: NavigationTask) -> None:
    act = CONTROLLERS[task.name]

    recorded = record_trajectories(task, act, range(6), num_threads=1)

    reached = np.flatnonzero(recorded["outcome"] == Outcome.SUCCESS)
    # Half of the goals indoors are behind a wall.
    assert len(reached) >= {"water": 5, "indoor": 3}[task.name]
    last = recorded["position"][recorded["steps"][reached], reached]
    # The swept segment passes the goal: its end may lie a step beyond the tolerance.
    distance = np.hypot(*(recorded["goal"][reached] - last).T)
    assert (
        distance < task.goal_tolerance_m + {"water": 0.5, "indoor": 0.02}[task.name]
    ).all()
    assert recorded["outcome_names"][recorded["outcome"][reached[0]]] == "success"


def test_rows_after_an_episode_are_blank(task: NavigationTask) -> None:
    act = CONTROLLERS[task.name]

    recorded = record_trajectories(task, act, range(6), num_threads=1, scans=True)

    longest = recorded["steps"].max()
    assert recorded["position"].shape == (longest + 1, 6, 2)
    assert recorded["action"].shape[:2] == (longest, 6)
    for k, steps in enumerate(recorded["steps"]):
        known = np.isfinite(recorded["position"][:, k]).all(axis=-1)
        np.testing.assert_array_equal(known, np.arange(longest + 1) <= steps)
        np.testing.assert_array_equal(known, np.isfinite(recorded["heading"][:, k]))
        if "scan" in recorded:
            seen = np.isfinite(recorded["scan"][:, k]).all(axis=-1)
            np.testing.assert_array_equal(known, seen)


def test_policy_sees_only_live_worlds_and_equal_seeds_give_equal_paths(
    task: NavigationTask,
) -> None:
    controller = CONTROLLERS[task.name]
    counts = []

    def act(observation: np.ndarray) -> np.ndarray:
        counts.append(len(observation))
        return controller(observation)

    together = record_trajectories(task, act, [3, 4, 5], num_threads=1)
    alone = record_trajectories(task, controller, [4], num_threads=1)

    assert counts[0] == 3
    assert sum(counts) == together["steps"].sum()
    steps = alone["steps"][0]
    np.testing.assert_array_equal(
        together["position"][: steps + 1, 1], alone["position"][:, 0]
    )


@pytest.mark.parametrize("name", TASKS)
def test_discrete_actions_are_recorded(name: str) -> None:
    task = make_task(name, actions="discrete", step_limit=2)

    recorded = record_trajectories(task, lambda o: np.full(len(o), 3), [0], num_threads=1)

    assert recorded["action"].tolist() == [[3], [3]]


@pytest.mark.parametrize(("name", "own"), [("water", SEA), ("indoor", ARENA)])
def test_only_what_a_task_has_is_recorded(name: str, own: set[str]) -> None:
    task = make_task(name, step_limit=1)

    recorded = record_trajectories(task, drift(task), SEEDS, num_threads=1)
    scanned = record_trajectories(task, drift(task), SEEDS, num_threads=1, scans=True)

    assert recorded.keys() == COMMON | own
    assert scanned.keys() - recorded.keys() == ({"scan"} if name == "indoor" else set())


@pytest.mark.parametrize("arena", ["paper", "scatter", "corridor"])
def test_recorded_obstacles_are_those_that_robots_hit(arena: str) -> None:
    task = make_task("indoor", arena=arena)

    recorded = record_trajectories(task, drift(task), range(8), num_threads=1)

    shapes = {"is_box": recorded["obstacle_is_box"]}
    shapes["half_size"] = recorded["obstacle_half_size"]
    for k in np.flatnonzero(recorded["outcome"] == Outcome.COLLISION):
        last = recorded["steps"][k]
        position, heading = recorded["position"][last, k], recorded["heading"][last, k]
        outline = posed(recorded["vehicle_outline"], position, heading)
        places = np.repeat(recorded["obstacles"][k, None], len(outline), axis=0)
        # A step is 18 mm, and what is 5 mm away counts as touched.
        nearest = clearance(outline, places, **shapes).min()
        assert -0.02 < nearest < 0.006
    assert (recorded["outcome"] == Outcome.COLLISION).sum() >= 5
    inside = np.abs(recorded["goal"]) < recorded["half_extent"]
    assert inside.all()


def test_recorded_scans_end_at_obstacles() -> None:
    task = make_task("indoor", arena="paper", step_limit=20)

    recorded = record_trajectories(task, turn_to_goal, [3], num_threads=1, scans=True)

    outline, angles = recorded["vehicle_outline"], recorded["beam_angles"]
    middle = 0.5 * (outline.min(axis=0) + outline.max(axis=0))
    for step in (0, 7, 20):
        scan = recorded["scan"][step, 0]
        tips = middle + scan[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        tips = posed(tips, recorded["position"][step, 0], recorded["heading"][step, 0])
        places = np.repeat(recorded["obstacles"], len(tips), axis=0)
        distance = clearance(
            tips, places, recorded["obstacle_is_box"], recorded["obstacle_half_size"]
        )
        hits = scan < 3.5
        assert hits.sum() > 10
        np.testing.assert_allclose(distance[hits], 0.0, atol=1e-4)


def test_recorded_sea_is_that_of_the_first_episode() -> None:
    short_task = make_task("water", step_limit=3)
    recorded = record_trajectories(short_task, drift(short_task), SEEDS, num_threads=1)

    sea = short_task.draw_episode(SEEDS[0]).arrays
    x, y = recorded["sea_x"][7], recorded["sea_y"][300]
    phase = sea["wavenumber_x"] * x + sea["wavenumber_y"] * y + sea["phase"]
    expected = np.sum(sea["amplitude"] * np.cos(phase))
    assert recorded["sea_elevation"][300, 7] == pytest.approx(expected, abs=1e-6)


def test_trajectories_survive_the_file(tmp_path: Path, short_task: NavigationTask) -> None:
    recorded = record_trajectories(short_task, drift(short_task), SEEDS, num_threads=1)

    path = save_trajectories(tmp_path / "run", recorded)

    assert path == tmp_path / "run" / "trajectories.npz"
    read = read_trajectories(tmp_path / "run")
    assert read.keys() == recorded.keys()
    for name, value in recorded.items():
        np.testing.assert_array_equal(read[name], value)


def test_bad_requests_name_the_value(tmp_path: Path, short_task: NavigationTask) -> None:
    with pytest.raises(ValueError, match="at least one episode"):
        record_trajectories(short_task, drift(short_task), [])
    with pytest.raises(ValueError, match="fps=0 must be at least 1"):
        write_video(short_task, drift(short_task), SEEDS, tmp_path / "x.mp4", fps=0)
    with pytest.raises(ValueError, match="height=63 must be even"):
        write_video(short_task, drift(short_task), SEEDS, tmp_path / "x.mp4", height=63)


@pytest.mark.render
def test_video_is_rendered(tmp_path: Path, short_task: NavigationTask) -> None:
    path = tmp_path / "videos" / "episodes.mp4"

    how = _write(short_task, path)

    assert how == "rendered"
    frames = _check(path, short_task)
    # The chase camera sees the sky, the one from above does not.
    sky = frames[0, 0].astype(int) @ [-1, 0, 1]
    above, behind = sky[: WIDTH - 8], sky[WIDTH + 8 :]
    assert abs(behind.mean() - above.mean()) > 15


@pytest.mark.render
@pytest.mark.parametrize("arena", ["paper", "scatter", "corridor"])
def test_top_camera_holds_the_arena_and_chase_camera_the_robot(arena: str) -> None:
    from gdrl_tasks.engines.dm_env import make_environment

    environment = make_environment(make_task("indoor", arena=arena))
    try:
        for seed in range(3):
            environment.task.next_episode_seed = seed
            environment.reset()
            top, chase = (_parts(environment.physics, name) for name in ("top", "chase"))
            walls = [top == f"obstacle_{number}" for number in range(4)]
            assert all(wall.any() for wall in walls)
            edge = np.ones_like(top, dtype=bool)
            edge[3:-3, 3:-3] = False
            assert set(top[edge]) <= {"floor"}
            assert {"goal_disc", "deck", "scan"} <= set(top.ravel())
            assert "scan" in chase
            row, column = np.argwhere(chase == "deck").mean(axis=0) / chase.shape
            assert 0.5 < row < 0.8
            assert column == pytest.approx(0.5, abs=0.02)
    finally:
        environment.close()


@pytest.mark.parametrize("report", ["exact", "held and noisy"])
def test_beams_end_on_what_they_hit_and_fade_out_where_they_hit_nothing(
    report: str,
) -> None:
    from gdrl_tasks.engines.dm_env import make_environment

    options: dict[str, Any] = {"num_beams": 72, "field_of_view_deg": 360.0}
    if report == "held and noisy":
        options |= {"scan_hold": True, "range_noise": True}
    task = make_task("indoor", arena="paper", **options)
    environment = make_environment(task)
    arrays, data = environment.task.arrays, environment.physics.data
    environment.task.next_episode_seed = 0
    environment.reset()
    held = 0
    for _ in range(8):
        before = arrays["scan"].copy()
        environment.step(4)
        held += np.array_equal(arrays["scan"], before)
    assert held >= (report == "held and noisy")

    task.draw_scenery(environment.physics, arrays)

    strips = _strips(environment.physics)
    shapes = task.arena.shapes
    for name in ("beams", "hits"):
        ends = strips[name][:, 1:3].mean(axis=1)
        assert len(ends) > 20
        places = np.repeat(arrays["obstacles"], len(ends), axis=0)
        distance = clearance(ends[:, :2], places, shapes.is_box, shapes.half_size)
        np.testing.assert_allclose(distance, 0.0, atol=1e-3)
    parts = [name for name in strips if name.startswith("fading")]
    # All beams are drawn that fit, and each once.
    assert len(strips["beams"]) + len(strips[parts[0]]) == 36
    middle, _ = task.body_centre(data.qpos[None])
    reach = [
        np.hypot(*(strips[name][:, 1:3].mean(axis=1)[:, :2] - middle).T) for name in parts
    ]
    np.testing.assert_allclose(reach[-1], 3.5, atol=1e-3)
    assert all((near < far).all() for near, far in itertools.pairwise(reach))
    opacity = [environment.physics.named.model.skin_rgba[name, "a"] for name in parts]
    assert opacity == sorted(opacity, reverse=True)
    assert opacity[-1] < 0.1
    for corners in strips.values():
        # The robot leans back by a thousandth as it drives.
        np.testing.assert_allclose(corners[..., 2], LIDAR_HEIGHT_M, atol=0.01)


def _strips(physics: Any) -> dict[str, np.ndarray]:
    """Corners of the drawn strips by skin, as a renderer gets them, ``[N, 4, 3]``."""
    model, data = physics.model.ptr, physics.data.ptr
    scene = mujoco.MjvScene(model, 1000)
    option, view = mujoco.MjvOption(), mujoco.MjvCamera()
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, option, None, view, everything, scene)
    vertices, strips = scene.skinvert.reshape(-1, 3), {}
    for skin in range(model.nskin):
        first, count = model.skin_vertadr[skin], model.skin_vertnum[skin]
        corners = vertices[first : first + count].reshape(-1, 4, 3)
        drawn = np.ptp(corners, axis=1).max(axis=-1) > 1e-6
        strips[mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SKIN, skin)] = corners[drawn]
    return strips


@pytest.mark.render
def test_failure_while_rendering_leaves_a_drawn_video(
    tmp_path: Path,
    short_task: NavigationTask,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fail(*_: object) -> np.ndarray:
        raise RuntimeError("lost the context")

    monkeypatch.setattr(frames_of, "_render", fail)
    path = tmp_path / "episodes.mp4"

    how = _write(short_task, path)

    assert how == "drawn"
    _check(path, short_task)
    assert "rendering failed: drawn from above" in caplog.text
    assert "lost the context" in caplog.text


def test_video_is_drawn_without_a_backend(
    tmp_path: Path,
    short_task: NavigationTask,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(video, "find_gl_backend", lambda: (None, "none here"))
    path = tmp_path / "episodes.mp4"

    with caplog.at_level(logging.WARNING):
        how = write_video(
            short_task, drift(short_task), SEEDS, path, height=HEIGHT, width=WIDTH
        )

    assert how == "drawn"
    _check(path, short_task)
    message = "no GL backend: drawn from above with matplotlib (none here)"
    assert message in caplog.text


def test_process_with_rendering_switched_off_draws(tmp_path: Path) -> None:
    path = tmp_path / "episodes.mp4"
    code = f"""
import numpy as np
from gdrl_tasks import make_task
from gdrl_torchrl.pictures.film.video import write_video
task = make_task("water", step_limit=3)
act = lambda observation: np.zeros((len(observation), 2))
size = dict(height={HEIGHT}, width={WIDTH})
print(write_video(task, act, {SEEDS}, {str(path)!r}, **size))
"""
    environment = os.environ | {
        "MUJOCO_GL": "disable",
        "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
    }

    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["drawn"]
    assert "no GL backend: drawn from above with matplotlib" in done.stderr
    _check(path, make_task("water"))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_films_run_at_a_whole_multiple_of_real_time() -> None:
    short_task = make_task("water", step_limit=3)
    recorded = record_trajectories(short_task, drift(short_task), [0, 1], num_threads=1)
    recorded["steps"] = np.array([100, 31])

    def film(max_frames: int) -> frames_of.Film:
        return frames_of.Film.of(recorded, fps=25, height=2, width=2, max_frames=max_frames)

    # 32.75 s are 818.75 frames of a 25th of a second.
    real, faster = film(999), film(300)
    assert (real.speed, faster.speed) == (1, 3)
    moments = faster.moments(1)
    # Three 25ths of a second are 0.48 control steps of 0.25 s.
    np.testing.assert_allclose(moments[:-1], 0.48 * np.arange(len(moments) - 1))
    assert moments[-1] == 31.0
    assert 12.0 in moments
    assert real.num_frames == (625 + 1) + (194 + 1) + 2 * 25


@pytest.mark.render
@pytest.mark.parametrize(("name", "fps"), [("water", 4), ("indoor", 25)])
def test_frames_of_control_steps_show_the_recorded_episode(name: str, fps: int) -> None:
    from gdrl_tasks.engines.dm_env import make_environment

    task = make_task(name, step_limit=4)
    recorded = record_trajectories(task, CONTROLLERS[name], [5], num_threads=1)
    # As many frames as control steps: 4 a second, and 25 at three times real time.
    film = frames_of.Film(recorded, {4: 1, 25: 3}[fps], fps, 96, 128)
    frames = list(frames_of.rendered_frames(task, film))

    environment = make_environment(task)
    draw_faster(environment.physics)
    environment.task.next_episode_seed = 5
    environment.reset()
    try:
        for step, frame in enumerate(frames):
            behind = environment.physics.render(96, 128, camera_id="chase")
            difference = np.abs(frame[:, 128:].astype(int) - behind)
            assert difference.max() <= 3
            if step < 4:
                environment.step(recorded["action"][step, 0])
    finally:
        environment.close()
    assert len(frames) == 5
    assert (frames[0] != frames[-1]).any()


@pytest.mark.parametrize("name", TASKS)
def test_replay_for_a_film_has_the_recorded_states_bit_for_bit(name: str) -> None:
    from gdrl_tasks.engines.dm_env import make_environment

    task = make_task(name, step_limit=20)
    recorded = record_trajectories(task, CONTROLLERS[name], [5], num_threads=1)
    steps, actions = int(recorded["steps"][0]), recorded["action"][:, 0]
    noted, plain = make_environment(task), make_environment(task)
    for environment in (noted, plain):
        environment.task.next_episode_seed = 5

    replay = frames_of._replay(noted, actions)

    count = task.spec.num_substeps
    assert len(replay.qpos) == steps * count + 1
    position, heading = task.planar_pose(replay.qpos[::count])
    np.testing.assert_array_equal(position, recorded["position"][: steps + 1, 0])
    np.testing.assert_array_equal(heading, recorded["heading"][: steps + 1, 0])
    plain.reset()
    for step in range(steps):
        plain.step(actions[step])
        after = replay.qpos[(step + 1) * count]
        np.testing.assert_array_equal(after, plain.physics.data.qpos)
    np.testing.assert_array_equal(noted.physics.get_state(), plain.physics.get_state())


@pytest.mark.parametrize("name", TASKS)
def test_frames_between_substeps_lie_between_their_states(name: str) -> None:
    from gdrl_tasks.engines.dm_env import make_environment

    task = make_task(name, step_limit=6)
    recorded = record_trajectories(task, CONTROLLERS[name], [5], num_threads=1)
    played, shown = make_environment(task), make_environment(task)
    played.task.next_episode_seed = shown.task.next_episode_seed = 5
    replay = frames_of._replay(played, recorded["action"][:, 0])
    shown.reset()
    count = task.spec.num_substeps

    frames_of._pose(shown, replay, 2.25 / count)

    data = shown.physics.data
    before, after = replay.qpos[2], replay.qpos[3]
    np.testing.assert_allclose(
        data.qpos[:3], 0.75 * before[:3] + 0.25 * after[:3], atol=1e-12
    )
    assert np.linalg.norm(data.qpos[3:7]) == pytest.approx(1.0)
    assert data.time == pytest.approx(2.25 * task.spec.substep_s)


def test_backend_that_is_not_there_is_found_out_in_another_process() -> None:
    problem = gl_backend._probe("no-such-backend")

    assert problem is not None
    assert "MUJOCO_GL" in problem
    assert gl_backend._probe("disable") == "rendering is switched off"


def test_backend_chosen_by_the_user_is_the_only_one_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried = []
    monkeypatch.delitem(sys.modules, "dm_control._render", raising=False)
    monkeypatch.setattr(gl_backend, "_probe", lambda name: tried.append(name) or "no")

    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert gl_backend.find_gl_backend() == (None, "MUJOCO_GL=osmesa: no")
    assert tried == ["osmesa"]

    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert gl_backend.find_gl_backend()[0] is None
    assert tried == ["osmesa", "egl", "osmesa"]


def _write(task: NavigationTask, path: Path) -> str:
    return write_video(task, drift(task), SEEDS, path, height=HEIGHT, width=WIDTH)


def _check(path: Path, task: NavigationTask) -> np.ndarray:
    """Two episodes of three control steps; the last frame of each stays for a second."""
    frames = iio.imread(path)
    # Real time: a frame every 40 ms of three control steps, and the last moment's.
    shown = math.ceil(3 * task.spec.control_interval_s / 0.04 - 1e-6) + 1
    size = (HEIGHT + caption_height(2 * WIDTH), 2 * WIDTH, 3)
    assert frames.shape == (2 * (shown + 25), *size)
    assert iio.immeta(path)["fps"] == 25
    assert iio.immeta(path)["codec"] == "h264"
    assert frames.std() > 10
    assert not list(path.parent.glob(".*partial*"))
    return frames


def _parts(physics: Any, camera: str) -> np.ndarray:
    """Names of the geoms that a camera sees, or ``scan``, ``[H, W]``."""
    number, kind = physics.render(240, 320, camera_id=camera, segmentation=True).transpose(
        2, 0, 1
    )
    count = physics.model.ngeom
    names = np.array([*(physics.model.id2name(i, "geom") for i in range(count)), ""])
    parts = names[np.where(kind == mujoco.mjtObj.mjOBJ_GEOM, number, count)]
    return np.where(kind == mujoco.mjtObj.mjOBJ_SKIN, "scan", parts)
