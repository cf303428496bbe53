"""Recorded episodes and their videos, with and without OpenGL."""

from __future__ import annotations

import logging
import math
import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from gdrl_tasks import NavigationTask, make_task
from gdrl_torchrl.pictures.captions import caption_height
from gdrl_torchrl.pictures.film import frames as frames_of
from gdrl_torchrl.pictures.film import gl_backend, video
from gdrl_torchrl.pictures.film.episodes import record_trajectories
from gdrl_torchrl.pictures.film.video import write_video
from tests.marks import full_but
from tests.pictures.film.drivers import SEEDS, drift

TASKS = ("water", "indoor")
HEIGHT, WIDTH = 64, 96


def test_bad_requests_name_the_value(tmp_path: Path, short_task: NavigationTask) -> None:
    with pytest.raises(ValueError, match="at least one episode"):
        record_trajectories(short_task, drift(short_task), [])
    with pytest.raises(ValueError, match="fps=0 must be at least 1"):
        write_video(short_task, drift(short_task), SEEDS, tmp_path / "x.mp4", fps=0)
    with pytest.raises(ValueError, match="height=63 must be even"):
        write_video(short_task, drift(short_task), SEEDS, tmp_path / "x.mp4", height=63)


@pytest.mark.render
@pytest.mark.parametrize("short_task", full_but(["water"], TASKS), indirect=True)
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
@pytest.mark.parametrize("short_task", full_but(["indoor"], TASKS), indirect=True)
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


@pytest.mark.full
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


def test_backend_that_is_not_there_is_found_out_in_another_process() -> None:
    problem = gl_backend.problem_with("no-such-backend")

    assert problem is not None
    assert "MUJOCO_GL" in problem
    assert gl_backend.problem_with("disable") == "rendering is switched off"


def test_backend_chosen_by_the_user_is_the_only_one_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried = []
    monkeypatch.delitem(sys.modules, "dm_control._render", raising=False)
    monkeypatch.setattr(gl_backend, "problem_with", lambda name: tried.append(name) or "no")

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
