"""Links inside a run directory, which lead to what is not the run's."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import numpy as np
import pytest

from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.faults import FaultFiles
from gdrl_torchrl.files.metrics import MetricsTable
from gdrl_torchrl.files.run_table import run_row
from gdrl_torchrl.files.safe_files import locked, open_own, written_aside
from gdrl_torchrl.files.trajectories import save_trajectories
from gdrl_torchrl.pictures import style
from gdrl_torchrl.runs.place import directory_of
from gdrl_torchrl.runs.run import run_experiment
from gdrl_torchrl.runs.tensorboard import ResumedTensorboardLogger
from tests.marks import full_but
from tests.small import compose


@pytest.fixture
def config(options_of, tmp_path):
    small = ["budget.agent_steps=80", "logger.video_episodes=0"]
    return compose([*options_of("gppo_water"), *small, f"runs_dir={tmp_path / 'runs'}"])


@pytest.fixture
def outside(tmp_path):
    """A folder that is not the run's; it must stay as it is."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "mine").write_text("mine")
    (folder / ".hidden").write_text("mine")
    (folder / "checkpoint-000000000001.torchrl").write_text("mine")
    before = contents(folder)
    yield folder
    assert contents(folder) == before


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def linked(run, name, target):
    path = run / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(target)
    return path


FOLDERS = ("checkpoints", "tensorboard", "final")
WRITTEN_INTO = (".lock", "metrics.csv")
REPLACED = (
    *(".config.partial.json", ".DONE.partial", ".provenance.partial.json"),
    *(".evaluation.partial.json", ".metrics.partial.csv", ".trajectories.partial.npz"),
    *("config.json", "evaluation.json", "trajectories.npz"),
    *(
        "final/policy.safetensors",
        "final/contract.json",
        "final/.policy.partial.safetensors",
    ),
    *("checkpoints/.hidden", "checkpoints/.checkpoint-000000000080.torchrl"),
    *("figures/learning_curve.png", "figures/.learning_curve.partial.png"),
)


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize("name", full_but(["checkpoints"], FOLDERS))
def test_a_folder_that_is_a_link_is_refused_without_loss(name, config, outside):
    run = directory_of(config).path
    linked(run, name, outside)
    with pytest.raises(RunDirectoryError, match=f"is a link.*runs_dir.*{name}"):
        run_experiment(config)
    # As the message says.
    (run / name).unlink()
    run_experiment(config)


def test_figures_that_are_a_link_are_left_out_without_loss(config, outside, caplog):
    run = directory_of(config).path
    linked(run, "figures", outside)
    assert run_experiment(config) == run
    assert "is a link" in caplog.text
    assert "the run is complete without it" in caplog.text


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize("name", WRITTEN_INTO)
def test_a_file_that_is_a_link_is_not_written_into(name, config, outside):
    run = directory_of(config).path
    for target in (outside / "mine", outside / "new"):
        path = linked(run, name, target)
        with pytest.raises(RunDirectoryError, match=f"is a link.*{name}"):
            run_experiment(config)
        path.unlink()


def test_what_is_written_anew_takes_the_place_of_links(config, outside):
    run = directory_of(config).path
    for name in REPLACED:
        linked(run, name, outside / "mine")
    assert run_experiment(config) == run
    assert not [
        path for path in run.rglob("*") if path.is_symlink() and path.name[0] != "."
    ]
    # Not ours, and so it stays.
    assert (run / "checkpoints" / ".hidden").is_symlink()


@pytest.mark.usefixtures("without_figures")
def test_a_run_directory_may_be_a_link_itself(config, tmp_path):
    run, scratch = directory_of(config).path, tmp_path / "scratch"
    scratch.mkdir()
    run.parent.mkdir(parents=True)
    run.symlink_to(scratch)
    assert run_experiment(config) == run
    assert (scratch / "DONE").exists()
    assert run.is_symlink()


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize("name", [".lock", "metrics.csv", "config.json", "DONE"])
def test_a_pipe_is_waited_for_by_nobody(name, config):
    run = directory_of(config).path
    run.mkdir(parents=True)
    os.mkfifo(run / name)
    if name == "config.json":
        # It is written anew.
        assert run_experiment(config) == run
        assert run_row(run)["state"] == "done"
    else:
        with pytest.raises(RunDirectoryError, match=f"{name} is not a file"):
            run_experiment(config)


def test_a_run_that_was_copied_by_links_leaves_its_original_alone(config, tmp_path):
    """As by ``cp -al``: the same files under two names."""
    original = run_experiment(config)
    before = contents(original)
    copy = tmp_path / "copy"
    for path in before:
        target = copy / path.relative_to(original)
        target.parent.mkdir(parents=True, exist_ok=True)
        os.link(path, target)
    again = directory_of(config).path
    again.rename(tmp_path / "aside")
    copy.rename(again)
    config.budget.agent_steps = 160
    assert run_experiment(config) == again
    assert [*contents(tmp_path / "aside").values()] == [*before.values()]


def test_fault_files_are_written_through_no_link(config, outside, tmp_path):
    run = tmp_path / "run"
    linked(run, "faults/update.safetensors", outside / "mine")
    faults = FaultFiles(run, {}, 20)
    assert faults._write("update.safetensors", {"kind": "update"})
    assert not (run / "faults" / "update.safetensors").is_symlink()
    other = tmp_path / "other"
    linked(other, "faults", outside)
    with pytest.raises(OSError, match="is a link"):
        FaultFiles(other, {}, 20)._write("update.safetensors", {"kind": "update"})


def test_every_writer_leaves_links_alone(outside, tmp_path):
    linked(tmp_path, ".trajectories.partial.npz", outside / "mine")
    save_trajectories(tmp_path, {"steps": np.arange(3)})
    linked(tmp_path, ".picture.partial.png", outside / "mine")
    style.save(style.new_figure(1.0, 1.0), tmp_path / "picture.png")
    linked(tmp_path, "metrics.csv", outside / "new")
    with pytest.raises(OSError, match="is a link"):
        MetricsTable(tmp_path / "metrics.csv", ("a",))
    linked(tmp_path, "run/tensorboard", outside)
    with pytest.raises(OSError, match="is a link"):
        ResumedTensorboardLogger(tmp_path / "run", 0)


def test_a_lock_empties_no_file(tmp_path):
    path = tmp_path / "file"
    path.write_text("mine")
    with locked(path):
        pass
    assert path.read_text() == "mine"


def test_files_get_the_permissions_that_the_user_asks_for(tmp_path):
    mask = os.umask(0o027)
    try:
        with written_aside(tmp_path / "file") as aside:
            aside.write_text("x")
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640


def test_after_an_error_there_is_what_was_there_before(tmp_path):
    path = tmp_path / "file"
    path.write_text("before")
    with pytest.raises(IsADirectoryError), written_aside(path) as aside:
        aside.write_bytes(Path("/").read_bytes())
    assert [*tmp_path.iterdir()] == [path]
    assert path.read_text() == "before"


def test_a_device_is_no_file():
    with pytest.raises(ValueError, match="is not a file"):
        open_own(Path("/dev/null"), os.O_WRONLY)
