"""Every notebook script runs as plain Python, made small by environment variables."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = sorted((Path(__file__).parents[1] / "notebooks_py").glob("*.py"))
SMALL = {"GDRL_SMOKE": "1", "GDRL_FRAMES": "1000"}
TRAINING = {"02_sac_on_dm_control", "03_ppo_on_gymnasium", "04_dqn_on_cartpole"}


def test_there_are_notebooks():
    assert {"01_population_evaluator", *TRAINING} <= {path.stem for path in SCRIPTS}


@pytest.mark.full
@pytest.mark.parametrize(
    "script",
    SCRIPTS,
    ids=lambda path: path.stem,
)
def test_a_notebook_runs_from_anywhere(script, tmp_path):
    result = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env=os.environ | SMALL,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip()
    # Libraries tell of their own doings in colours, which no reader has asked for.
    assert "INFO" not in result.stdout + result.stderr
    assert "\x1b" not in result.stdout + result.stderr
    assert not list(tmp_path.iterdir())
    if script.stem in TRAINING:
        last = result.stdout.splitlines()[-1]
        found = re.fullmatch(
            r"(\d+) evaluations, (\d+) switches, (\d+) population steps", last
        )
        assert found is not None, result.stdout
        evaluations, switches, steps = map(int, found.groups())
        assert 0 <= switches <= evaluations
        assert evaluations >= 1
        assert steps > 0


def test_the_first_notebook_is_short():
    (first,) = (path for path in SCRIPTS if path.stem == "01_population_evaluator")
    assert len(first.read_text().splitlines()) < 60
