"""Benchmarks still run: what they measure is checked against a reference by themselves."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("ppo_epoch", "time_over_by_hand"),
        ("rainbow_update", "epsilon_greedy"),
        ("collection", "indoor"),
    ],
)
def test_a_benchmark_checks_itself_and_says_what_it_found(name, found):
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", "--repeats", "1"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert found in json.loads(done.stdout.splitlines()[-1])
