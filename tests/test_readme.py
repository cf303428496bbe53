"""What the README shows runs, and shows something."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text()


@pytest.mark.full
def test_its_python_runs_and_some_children_reach_goals(tmp_path):
    (block,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-c", block],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    numbers = [float(number) for number in re.findall(r"\d+\.", done.stdout)]
    assert len(numbers) == 11
    assert 0.0 < max(numbers) <= 10.0


def test_its_commands_exist():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    shown = set(re.findall(r"\.venv/bin/(gdrl-\w+)", TEXT))
    assert shown == scripts.keys() & shown
    assert {"gdrl-train", "gdrl-evaluate", "gdrl-video", "gdrl-play"} <= shown


def test_its_pictures_exist():
    pictures = re.findall(r"\]\((docs/images/[^)]+)\)", TEXT)
    assert pictures
    assert all((ROOT / picture).exists() for picture in pictures)


def test_it_begins_with_where_the_code_comes_from():
    commands = re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)[0].splitlines()
    assert [line.split()[0] for line in commands[:3]] == ["git", "cd", "make"]
