"""Recorded episodes and their videos, with and without OpenGL."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from gdrl_tasks import NavigationTask, Outcome, make_task
from gdrl_tasks.controllers import pursuit
from gdrl_torchrl.analysis.captions import caption_height
from gdrl_torchrl.analysis.run_files import read_trajectories
from gdrl_torchrl.training import gl_backend, video
from gdrl_torchrl.training.video import (
    record_trajectories,
    save_trajectories,
    write_video,
)

SEEDS = [11, 12]
HEIGHT, WIDTH = 64, 96


def drift(observation: np.ndarray) -> np.ndarray:
    return np.zeros((len(observation), 2))


@pytest.fixture
def short_task() -> NavigationTask:
    """Episodes of three control steps."""
    return make_task("water", step_limit=3)


def test_recorded_successes_end_at_their_goal() -> None:
    task = make_task("water")

    recorded = record_trajectories(task, pursuit, range(6), num_threads=1)

    reached = np.flatnonzero(recorded["outcome"] == Outcome.SUCCESS)
    assert len(reached) >= 5
    last = recorded["position"][recorded["steps"][reached], reached]
    # The swept segment passes the goal: its end may lie a step beyond the tolerance.
    distance = np.hypot(*(recorded["goal"][reached] - last).T)
    assert (distance < task.goal_tolerance_m + 0.5).all()
    assert recorded["outcome_names"][recorded["outcome"][reached[0]]] == "success"


def test_rows_after_an_episode_are_blank() -> None:
    recorded = record_trajectories(make_task("water"), pursuit, range(6), num_threads=1)

    longest = recorded["steps"].max()
    assert recorded["position"].shape == (longest + 1, 6, 2)
    assert recorded["action"].shape == (longest, 6, 2)
    for k, steps in enumerate(recorded["steps"]):
        known = np.isfinite(recorded["position"][:, k]).all(axis=-1)
        np.testing.assert_array_equal(known, np.arange(longest + 1) <= steps)
        np.testing.assert_array_equal(known, np.isfinite(recorded["heading"][:, k]))


def test_policy_sees_only_live_worlds_and_equal_seeds_give_equal_paths() -> None:
    task = make_task("water")
    counts = []

    def act(observation: np.ndarray) -> np.ndarray:
        counts.append(len(observation))
        return pursuit(observation)

    together = record_trajectories(task, act, [3, 4, 5], num_threads=1)
    alone = record_trajectories(task, pursuit, [4], num_threads=1)

    assert counts[0] == 3
    assert sum(counts) == together["steps"].sum()
    steps = alone["steps"][0]
    np.testing.assert_array_equal(
        together["position"][: steps + 1, 1], alone["position"][:, 0]
    )


def test_discrete_actions_are_recorded() -> None:
    task = make_task("water", actions="discrete", step_limit=2)

    recorded = record_trajectories(task, lambda o: np.full(len(o), 3), [0], num_threads=1)

    assert recorded["action"].tolist() == [[3], [3]]


def test_recorded_sea_is_that_of_the_first_episode(short_task: NavigationTask) -> None:
    recorded = record_trajectories(short_task, drift, SEEDS, num_threads=1)

    sea = short_task.draw_episode(SEEDS[0]).arrays
    x, y = recorded["sea_x"][7], recorded["sea_y"][300]
    phase = sea["wavenumber_x"] * x + sea["wavenumber_y"] * y + sea["phase"]
    expected = np.sum(sea["amplitude"] * np.cos(phase))
    assert recorded["sea_elevation"][300, 7] == pytest.approx(expected, abs=1e-6)


def test_trajectories_survive_the_file(tmp_path: Path, short_task: NavigationTask) -> None:
    recorded = record_trajectories(short_task, drift, SEEDS, num_threads=1)

    path = save_trajectories(tmp_path / "run", recorded)

    assert path == tmp_path / "run" / "trajectories.npz"
    read = read_trajectories(tmp_path / "run")
    assert read.keys() == recorded.keys()
    for name, value in recorded.items():
        np.testing.assert_array_equal(read[name], value)


def test_bad_requests_name_the_value(tmp_path: Path, short_task: NavigationTask) -> None:
    with pytest.raises(ValueError, match="at least one episode"):
        record_trajectories(short_task, drift, [])
    with pytest.raises(ValueError, match="height=63 must be even"):
        write_video(short_task, drift, SEEDS, tmp_path / "x.mp4", height=63)


@pytest.mark.render
def test_video_is_rendered(tmp_path: Path, short_task: NavigationTask) -> None:
    path = tmp_path / "videos" / "episodes.mp4"

    how = write_video(short_task, drift, SEEDS, path, height=HEIGHT, width=WIDTH)

    assert how == "rendered"
    frames = _check(path)
    # The sky of the chase camera: the view from above has none.
    sky = frames[0, :4, :].astype(int)
    assert sky[:, WIDTH + 8 :].mean() > sky[:, : WIDTH - 8].mean() + 50


@pytest.mark.render
def test_failure_while_rendering_leaves_a_drawn_video(
    tmp_path: Path,
    short_task: NavigationTask,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fail(*_: object) -> np.ndarray:
        raise RuntimeError("lost the context")

    monkeypatch.setattr(video, "_render", fail)
    path = tmp_path / "episodes.mp4"

    how = write_video(short_task, drift, SEEDS, path, height=HEIGHT, width=WIDTH)

    assert how == "drawn"
    _check(path)
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
        how = write_video(short_task, drift, SEEDS, path, height=HEIGHT, width=WIDTH)

    assert how == "drawn"
    _check(path)
    message = "no GL backend: drawn from above with matplotlib (none here)"
    assert message in caplog.text


def test_process_with_rendering_switched_off_draws(tmp_path: Path) -> None:
    path = tmp_path / "episodes.mp4"
    code = f"""
import numpy as np
from gdrl_tasks import make_task
from gdrl_torchrl.training.video import write_video
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
    _check(path)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_long_episodes_are_shown_in_fewer_frames(short_task: NavigationTask) -> None:
    recorded = record_trajectories(short_task, drift, [0, 1], num_threads=1)
    recorded["steps"] = np.array([100, 31])

    def film(**options: object) -> video._Film:
        options = {"fps": None, "height": 2, "width": 2, "max_frames": 999} | options
        return video._Film.of(recorded, **options)

    every, third = film(), film(max_frames=50)
    assert (every.stride, every.fps, every.speed) == (1, 8, 2.0)
    assert (third.stride, third.fps, third.speed) == (3, 6, 4.5)
    assert third.steps_shown(1) == [*range(0, 31, 3), 31]
    assert every.num_frames == 101 + 32 + 2 * 8
    assert film(fps=20).speed == 5.0


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


def _check(path: Path) -> np.ndarray:
    """Two episodes of four frames each, the last of which stays for a second."""
    frames = iio.imread(path)
    assert frames.shape == (2 * (4 + 8), HEIGHT + caption_height(2 * WIDTH), 2 * WIDTH, 3)
    assert iio.immeta(path)["fps"] == 8.0
    assert iio.immeta(path)["codec"] == "h264"
    assert frames.std() > 10
    assert not list(path.parent.glob(".*partial*"))
    return frames
