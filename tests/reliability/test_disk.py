"""A disk that is full, at whatever point of a run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gdrl_torchrl.cli.evaluate import evaluate_run
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.run_table import run_row
from gdrl_torchrl.runs.run import run_experiment

ROOM_KB = (0, 4, 12, 24, 48, 100, 160, 240, 400)
"""Room that a run finds: for nothing at all, up to most of it."""


@pytest.fixture
def run_on(options_of, without_figures):
    def run(folder):
        small = ["budget.agent_steps=400", "checkpoint.interval_s=0"]
        options = [*options_of("gppo_water"), *small, f"runs_dir={folder}"]
        return run_experiment(load_experiment(options))

    return run


@pytest.mark.parametrize(
    "rooms_kb", [ROOM_KB[::3], pytest.param(ROOM_KB, marks=pytest.mark.full)], ids=len
)
def test_a_full_disk_is_named_and_nothing_that_was_saved_is_lost(
    rooms_kb, small_disk, leave_room, run_on, tmp_path, rows_of, evaluation_of
):
    whole = run_on(tmp_path / "whole")
    refused = {}
    for kilobytes in rooms_kb:
        filler = leave_room(small_disk, kilobytes)
        try:
            run_on(small_disk / "runs")
        except RunDirectoryError as error:
            refused[kilobytes] = str(error)
        filler.unlink()
    assert len(refused) >= len(rooms_kb) // 2, (
        f"only with room for {[*refused]} KB was there an error"
    )
    for message in refused.values():
        assert "No space left on device" in message
        assert str(small_disk / "runs") in message
    path = run_on(small_disk / "runs")
    assert rows_of(path) == rows_of(whole)
    assert evaluation_of(path) == evaluation_of(whole)
    assert not [p for p in path.rglob(".*") if p.name != ".lock"]


def test_a_finished_run_on_a_disk_that_is_only_read_can_be_asked_for(
    small_disk, run_on, evaluation_of
):
    done = run_on(small_disk / "runs")
    before = evaluation_of(done)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    assert run_on(small_disk / "runs") == done
    assert run_row(done)["state"] == "done"
    again = evaluate_run([f"run={done}"])
    assert again["params_sha256"] == before["params_sha256"]
    with pytest.raises(RunDirectoryError, match="Read-only file system") as refused:
        run_on(small_disk / "others")
    assert str(small_disk) in str(refused.value)


def in_its_own_mounts(commands, *, cwd=None, **environment):
    """Run a shell's commands where their mounts are seen by nobody else."""
    try:
        done = subprocess.run(["unshare", "-m", "true"], capture_output=True, check=False)
    except OSError as error:
        pytest.skip(f"mounts need privileges that are not here: {error}")
    if done.returncode:
        pytest.skip(f"mounts need privileges that are not here: {done.stderr.decode()}")
    return subprocess.run(
        ["unshare", "-m", "--propagation", "private", "sh", "-ec", commands],
        cwd=cwd,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )


SHARED_MEMORY = {
    "read-only": "mount -t tmpfs -o ro none /dev/shm",
    "absent": """
        mount -t tmpfs none "$FOLDER"
        for name in null zero full random urandom; do
            touch "$FOLDER/$name"; mount --bind "/dev/$name" "$FOLDER/$name"
        done
        mount --rbind "$FOLDER" /dev
        test ! -e /dev/shm
    """,
}


@pytest.mark.full
@pytest.mark.parametrize("how", SHARED_MEMORY)
def test_rainbow_without_shared_memory_says_so_in_a_line(how, tmp_path):
    (tmp_path / "dev").mkdir()
    train = (
        f"{sys.executable} -m gdrl_torchrl.cli.train experiment=grainbow_indoor toy=true"
    )
    done = in_its_own_mounts(
        f"{SHARED_MEMORY[how]}\n{train}", cwd=tmp_path, FOLDER=str(tmp_path / "dev")
    )
    assert done.returncode == 1, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert "/dev/shm cannot be used" in line
    assert "mount it" in line
    assert "Traceback" not in done.stderr


@pytest.mark.full
def test_a_container_whose_package_and_home_are_only_read_trains(tmp_path):
    site = tmp_path / "site"
    root = Path(__file__).parents[2]
    without = shutil.ignore_patterns("__pycache__")
    for name, source in (
        ("gdrl_torchrl", root / "gdrl_torchrl"),
        ("gdrl_tasks", root / "tasks" / "gdrl_tasks"),
    ):
        shutil.copytree(source, site / name, ignore=without)
    (tmp_path / "home").mkdir()
    options = "experiment=gppo_water toy=true logger.video_episodes=0"
    done = in_its_own_mounts(
        f"""
        mount --bind "{site}" "{site}"; mount -o remount,bind,ro "{site}"
        mount -t tmpfs -o ro none "{tmp_path}/home"
        {sys.executable} -c 'import gdrl_tasks; print(gdrl_tasks.__file__)'
        {sys.executable} -m gdrl_torchrl.cli.train {options}
        """,
        cwd=tmp_path,
        PYTHONPATH=str(site),
        HOME=str(tmp_path / "home"),
    )
    assert done.returncode == 0, done.stderr
    where, run = done.stdout.splitlines()
    assert where.startswith(str(site))
    assert run_row(tmp_path / run)["state"] == "done"
    assert done.stderr.count("compiled functions cannot be kept") == 1
    assert "Traceback" not in done.stderr
