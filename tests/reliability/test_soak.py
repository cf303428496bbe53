"""Long runs: memory, open files and threads stay as they are."""

from __future__ import annotations

import os
import statistics

import pytest

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.runs.monitor import RunMonitor
from gdrl_torchrl.runs.run import run_experiment

EVALUATIONS = 200
SETTLED = 50
"""Evaluations after which caches are filled: graphs, kernels, the allocator's pools."""
MOST_GROWTH_KB = 10_000
"""Of 150 evaluations: 66 KB each, where one's scores and genomes take more."""


def resident_kb():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


@pytest.mark.full
@pytest.mark.parametrize(
    "experiment",
    ["grainbow_indoor", "gppo_water", "erl_indoor", "paired_water", "ga_water"],
)
@pytest.mark.usefixtures("without_figures")
def test_nothing_grows_over_200_evaluations(experiment, options_of, tmp_path, monkeypatch):
    samples = []
    note = RunMonitor._note_evaluation

    def note_and_sample(monitor, evaluation):
        note(monitor, evaluation)
        samples.append(
            (
                resident_kb(),
                len(os.listdir("/proc/self/fd")),
                len(os.listdir("/proc/self/task")),
            )
        )
        if len(samples) >= EVALUATIONS:
            monitor.budget.wall_s = 1e-9

    monkeypatch.setattr(RunMonitor, "_note_evaluation", note_and_sample)
    options = [
        *options_of(experiment),
        f"runs_dir={tmp_path}",
        "checkpoint.interval_s=0",
        "budget.agent_steps=1000000",
        "budget.total_steps=100000000",
        "simulation.num_threads=2",
    ]
    config = load_experiment(options)
    if hasattr(config.evolution, "period_episodes"):
        config.evolution.period_episodes = 4
    run_experiment(config)
    assert len(samples) >= EVALUATIONS
    memory, files, threads = zip(*samples[SETTLED:], strict=True)
    growth = statistics.median(memory[-20:]) - statistics.median(memory[:20])
    print(
        f"{experiment}: {len(samples)} evaluations, memory {growth:+.0f} KB, files "
        f"{files[0]} to {files[-1]}, threads {threads[0]} to {threads[-1]}"
    )
    assert growth < MOST_GROWTH_KB
    assert max(files) == files[0]
    assert max(threads) == threads[0]
