"""Runs so small that they can be started, killed and broken many times."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

import gdrl_torchrl.conf
from gdrl_torchrl.evolution.settings import EvolutionConfig
from tests.small import compose, easy_options, small_options

ROWS = 90
DISK_KB = 4096
# Children so different that some are better, and a test that so few episodes can pass:
# there are hand-overs.
GENETIC = ["evolution.mut_v=1.0", "evolution.level=0.9"]


class Bomb:
    """Leaves a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


@pytest.fixture
def bomb_for():
    """Makes a thing that leaves a file when it is unpickled."""
    return Bomb


def pytest_generate_tests(metafunc):
    """Runs a test for ``every_experiment``, or for ``any_experiment`` but the longest."""
    folder = Path(gdrl_torchrl.conf.__path__[0], "experiment")
    names = {path.stem for path in folder.glob("*.yaml")}
    longest = {"grainbow_indoor", "gppo_water"}
    kinds = {"every_experiment": names, "any_experiment": names - longest}
    for argument in kinds.keys() & set(metafunc.fixturenames):
        metafunc.parametrize(argument, sorted(kinds[argument]))


@pytest.fixture
def options_of():
    """Overrides that make an experiment small: some 90 rows in a few seconds."""

    def options(experiment):
        chosen = small_options(experiment)
        config = compose(chosen)
        chosen += easy_options(config.task.name)
        evolution = config.evolution
        is_genetic = evolution.enabled and isinstance(evolution, EvolutionConfig)
        # Controls have children without differences.
        if is_genetic and evolution.mut_v:
            chosen += GENETIC
        # An evaluation a row, where there is no agent.
        total = 3000 if config.algorithm.name == "ga" else "null"
        budget = [f"budget.total_steps={total}", f"budget.agent_steps={40 * ROWS}"]
        return [*chosen, *budget]

    return options


@pytest.fixture
def evaluation_of():
    """A run's evaluation, without the clock."""
    return lambda run: json.loads((run / "evaluation.json").read_text()) | {"wall_s": None}


@pytest.fixture
def small_disk(tmp_path):
    """A folder on a file system of four megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_KB}k", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"a small file system cannot be mounted here: {error}")
    if mounted.returncode:
        pytest.skip(f"a small file system cannot be mounted here: {mounted.stderr}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture
def leave_room():
    def leave(disk, kilobytes):
        """Fill a file system until there is room for so much; the file that fills it."""
        filler = disk / "filler"
        filler.write_bytes(bytes(shutil.disk_usage(disk).free - 1024 * kilobytes))
        return filler

    return leave
