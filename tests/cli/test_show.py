"""``gdrl-video`` and ``gdrl-play``: what they ask for, and what they say of mistakes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

MODULES = ("video", "play")


def command(module, *arguments, **env):
    return subprocess.run(
        [sys.executable, "-m", f"gdrl_torchrl.cli.{module}", *arguments],
        env=os.environ | env,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("module", MODULES)
def test_help_has_a_sentence_for_every_option_and_two_examples(module):
    page = command(module, "--help")
    assert page.returncode == 0, page.stderr
    options, examples = page.stdout.split("examples:")
    assert examples.count(f"gdrl-{module} run=") == 2
    rows = [line.split(None, 1) for line in options.splitlines() if "=<" in line[:30]]
    assert len(rows) >= 4
    assert all(meaning.strip() for _, meaning in rows)


@pytest.mark.parametrize("module", MODULES)
def test_help_and_mistakes_need_neither_torch_nor_mujoco(module):
    code = (
        f"import sys; import gdrl_torchrl.cli.{module}; "
        "print(sorted({'torch', 'mujoco', 'numba', 'hydra'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("module", "arguments", "said"),
    [
        ("video", [], "run=<folder> must be given"),
        ("play", [], "run=<folder> must be given"),
        ("video", ["run=x", "episode=3"], "episode=3 must be one of run=..., episodes=..."),
        ("video", ["run=x", "episodes=abc"], "episodes=abc must be a whole number from 1"),
        ("video", ["run=x", "episodes=0"], "episodes=0 must be a whole number from 1"),
        ("video", ["run=x", "seconds=nan"], "seconds=nan must be a number from 0.1"),
        ("video", ["run=x", "file=film.avi"], "file=film.avi must end in .mp4"),
        ("play", ["run=x", "camera=side"], "camera=side must be one of chase, top, free"),
        ("play", ["run=x"], "DISPLAY= must name a screen"),
        ("video", ["run=/nowhere"], "run=/nowhere must be a run directory"),
    ],
)
def test_a_mistake_is_told_in_a_line(module, arguments, said):
    done = command(module, *arguments, DISPLAY="", WAYLAND_DISPLAY="")
    assert done.returncode == 1
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert said in line


@pytest.mark.full
def test_a_film_is_made_of_a_run_with_a_line_of_progress(tmp_path):
    small = ("evaluation.episodes=2", "budget.total_steps=600", f"runs_dir={tmp_path}")
    trained = command("train", "experiment=gppo_water", "toy=true", *small)
    assert trained.returncode == 0, trained.stderr
    run = Path(trained.stdout.split()[-1])
    assert not (run / "videos").exists()
    options = ("episodes=1", "seconds=0.4", "task.step_limit=8")
    done = command("video", f"run={run}", *options, MUJOCO_GL="off")
    assert done.returncode == 0, done.stderr
    film = run / "videos" / "episodes.mp4"
    assert done.stdout.splitlines() == [str(film)]
    assert film.stat().st_size > 1000
    assert "frame" in done.stderr
    assert "Traceback" not in done.stderr
