"""Searches of many processes, and on disks that are full."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

SCRIPTS = Path(sysconfig.get_path("scripts"))
ONE_OF_MANY = """
import json, pathlib, sys, time
from gdrl_torchrl.cli.trials.search import Search
from gdrl_torchrl.config.search import SearchConfig

folder, number, storage = sys.argv[1:]

def run(experiment, overrides):
    time.sleep(0.1)
    path = pathlib.Path(folder, f"{number}-{time.monotonic_ns()}")
    path.mkdir(parents=True)
    (path / "evaluation.json").write_text(json.dumps({"success_rate": 0.5}))
    return path

Search(
    SearchConfig(
        overrides=["experiment=gppo_water", f"runs_dir={folder}/runs"],
        params={"evolution.mut_v": "interval(0.01, 1.0)"},
        num_trials=7,
        total_steps=[1000],
        storage=storage,
    ),
    run,
).optimize()
"""


@pytest.mark.full
@pytest.mark.parametrize("storage", ["journal", "sqlite"])
def test_processes_at_one_search_run_as_many_trials_as_asked(tmp_path, storage):
    command = [sys.executable, "-c", ONE_OF_MANY, str(tmp_path)]
    processes = [
        subprocess.Popen([*command, str(n), storage], stderr=subprocess.PIPE, text=True)
        for n in range(3)
    ]
    for process in processes:
        _, told = process.communicate(timeout=500)
        assert process.returncode == 0, told
    results = list(tmp_path.rglob("evaluation.json"))
    assert len(results) == 7
    by_process = {path.parent.name.split("-")[0] for path in results}
    print(f"{storage}: 7 trials of 7, by {len(by_process)} processes of 3")


@pytest.mark.full
def test_a_full_disk_uses_no_trial_up(small_disk, leave_room):
    """Twice as many starts as trials, on a disk with room for no run."""
    command = [
        *(SCRIPTS / "gdrl-search", "+search=gppo_water", f"runs_dir={small_disk / 'runs'}"),
        *("search.num_trials=2", "search.total_steps=[200]", "search.episodes=2"),
        *("search.seeds=[0]", "task.step_limit=12", "algorithm.frames_per_batch=256"),
        *("algorithm.num_epochs=1", "checkpoint.interval_s=0"),
    ]

    def search():
        return subprocess.run(command, capture_output=True, text=True, timeout=300)

    for _ in range(2):
        filler = leave_room(small_disk, 40)
        full = search()
        filler.unlink()
        assert full.returncode == 1
        assert full.stderr.strip().splitlines()[-1].startswith("error: ")
        assert "No space left on device" in full.stderr
        assert "Traceback" not in full.stderr
    done = search()
    assert done.returncode == 0, done.stderr
    *table, _ = done.stdout.strip().splitlines()
    assert [line.split()[1] for line in table] == ["complete", "complete"]
