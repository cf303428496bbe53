"""Runs that cost nothing, for tests of searches."""

from __future__ import annotations

import json
import signal

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.cli.trials.search import Search
from gdrl_torchrl.config.search import SearchConfig
from gdrl_torchrl.runs.run import InterruptedRunError

BEST_MUT_V = 0.2


class FakeRuns:
    """Runs of no cost whose success falls off with the distance to a best value."""

    def __init__(self, folder, *, fail_at=None, stop_at=None, rate=None, error=None):
        self.folder, self.fail_at, self.stop_at = folder, fail_at, stop_at
        self.error = error or ValueError("mut_v=2 must be <= 1")
        self.experiments = []
        self.rate = rate or self.of_mutation

    @staticmethod
    def of_mutation(experiment):
        return 1.0 - abs(experiment.evolution.mut_v - BEST_MUT_V) - 0.01 * experiment.seed

    def __call__(self, experiment, overrides):
        if not self.experiments:
            # Composing takes a third of a second: the first is as good as any.
            assert load_experiment(overrides) == experiment
        self.experiments.append(experiment)
        number = len(self.experiments)
        if number == self.stop_at:
            raise InterruptedRunError(signal.SIGTERM, self.folder)
        if number == self.fail_at:
            raise self.error
        path = self.folder / f"run_{number}"
        path.mkdir(parents=True)
        record = {"success_rate": self.rate(experiment)}
        (path / "evaluation.json").write_text(json.dumps(record))
        return path


def config_of(folder, **options):
    defaults = {
        "overrides": ["experiment=gppo_water", f"runs_dir={folder}"],
        "params": {"evolution.mut_v": "interval(0.01, 1.0)"},
        "num_trials": 6,
        "total_steps": [1000],
    }
    return SearchConfig(**(defaults | options))


def search_of(tmp_path, runs=None, **options):
    runs = runs or FakeRuns(tmp_path / "fake")
    search = Search(config_of(tmp_path / "runs", **options), runs)
    return search, runs
