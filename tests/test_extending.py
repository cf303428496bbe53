"""The outside package of examples/extending, installed from its wheel and run."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with the example and nothing else."""
    folder = tmp_path_factory.mktemp("extending")
    source = shutil.copytree(ROOT / "examples" / "extending", folder / "source")
    options = ["--no-deps", "--no-build-isolation", "--quiet"]
    build = [*PIP, "wheel", *options, "--wheel-dir", folder, source]
    subprocess.run(build, check=True, cwd=folder)
    (wheel,) = folder.glob("gdrl_example-*.whl")
    target = folder / "site"
    subprocess.run(
        [*PIP, "install", "--no-deps", "--quiet", "--target", target, wheel], check=True
    )
    return target


@pytest.fixture
def command(installed, tmp_path):
    def run(module, *arguments):
        return subprocess.run(
            [sys.executable, "-m", f"gdrl_torchrl.cli.{module}", *arguments],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(installed)},
            capture_output=True,
            text=True,
            check=False,
        )

    return run


@pytest.mark.full
def test_its_operator_algorithm_and_task_train_together(command):
    trained = command("train", "experiment=a2c_pond", "toy=true")
    assert trained.returncode == 0, trained.stderr
    run = trained.stdout.split()[-1]
    assert run.startswith("runs/a2c_pond/")
    listed = command("runs", "runs", "evolution.mutation=cauchy")
    assert listed.stdout.splitlines()[1].startswith("done")
    assert " cauchy_a2c " in listed.stdout
    helped = command("train", "--help", "task=pond", "algorithm=a2c")
    assert "task.width_m=" in helped.stdout, helped.stderr
    evaluated = command("evaluate", f"run={run}", "episodes=4", "task.width_m=6.0")
    assert evaluated.returncode == 0, evaluated.stderr
    assert json.loads(evaluated.stdout)["episodes"] == 4


@pytest.mark.full
def test_the_commands_of_its_readme_train_one_run_each(command):
    text = (ROOT / "examples" / "extending" / "README.md").read_text()
    lines = re.findall(r"^gdrl-train (.+)$", text, re.MULTILINE)
    assert len(lines) >= 2
    runs = set()
    for line in lines:
        done = command("train", *line.split())
        assert done.returncode == 0, done.stderr
        assert "already complete" not in done.stderr
        runs.add(done.stdout.split()[-1])
    assert len(runs) == len(lines)


@pytest.mark.full
@pytest.mark.parametrize(
    ("override", "said"),
    [("task.width_m=50", "width_m=50"), ("algorithm.num_worlds=3", "frames_per_batch=256")],
)
def test_its_options_are_checked_as_ours(override, said, command):
    refused = command("train", "experiment=a2c_pond", override)
    assert refused.returncode != 0
    assert said in refused.stderr


@pytest.mark.full
def test_its_parts_go_with_ours(command):
    for overrides in (
        ("experiment=gppo_water", "evolution=cauchy"),
        ("experiment=gppo_water", "task=pond"),
    ):
        shown = command("train", *overrides, "--cfg", "job")
        assert shown.returncode == 0, shown.stderr


def test_without_it_its_names_are_unknown(tmp_path):
    refused = subprocess.run(
        [sys.executable, "-m", "gdrl_torchrl.cli.train", "experiment=a2c_pond"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert refused.returncode != 0
    assert "a2c_pond" in refused.stderr
