"""Searches: what they try, when they give up on it, and how they go on."""

from __future__ import annotations

import dataclasses
import errno
import json
import re
import shlex
import signal
import subprocess
import sysconfig
import threading
from importlib import resources
from pathlib import Path

import pytest

from gdrl_torchrl.agents.collectors.worker import WorkerDiedError
from gdrl_torchrl.agents.update import NonFiniteUpdateError
from gdrl_torchrl.cli.search import load_search
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.cli.trials import journal as search_journal
from gdrl_torchrl.cli.trials.search import Search, search_table
from gdrl_torchrl.config.search import SearchConfig
from gdrl_torchrl.files.directory import RunDirectory
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.safe_files import UnreadableFileError
from gdrl_torchrl.runs.run import InterruptedRunError, TrainingDivergedError
from tests.marks import full_but

SCRIPTS = Path(sysconfig.get_path("scripts"))
SEARCHES = sorted(
    entry.name.removesuffix(".yaml")
    for entry in resources.files("gdrl_torchrl.conf").joinpath("search").iterdir()
)
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


@pytest.mark.parametrize("storage", full_but(["journal"], ["journal", "sqlite"]))
def test_the_best_trial_is_the_one_with_the_highest_mean_over_seeds(tmp_path, storage):
    search, runs = search_of(tmp_path, seeds=[0, 3], storage=storage)
    search.optimize()
    values = [experiment.evolution.mut_v for experiment in runs.experiments]
    assert values[::2] == values[1::2]
    assert [experiment.seed for experiment in runs.experiments] == [0, 3] * 6
    nearest = min(values, key=lambda value: abs(value - BEST_MUT_V))
    best = search.best()
    assert best.user_attrs["overrides"] == [f"evolution.mut_v={nearest:.4g}"]
    expected = 1.0 - abs(nearest - BEST_MUT_V) - 0.015
    assert best.value == pytest.approx(expected, abs=1e-4)
    assert search_table(search).splitlines()[0].startswith(f"{best.value:.3f}  complete")


@pytest.mark.full
def test_trials_differ_and_come_nearer_than_chance(tmp_path):
    search, runs = search_of(tmp_path, num_trials=24)
    search.optimize()
    values = [experiment.evolution.mut_v for experiment in runs.experiments]
    assert len(set(values)) == 24
    # Of uniform draws a tenth would be as near.
    assert sum(abs(value - BEST_MUT_V) < 0.05 for value in values[12:]) > 3


def test_a_bad_trial_ends_early_and_a_good_one_gets_every_budget(tmp_path):
    search, runs = search_of(tmp_path, num_trials=8, total_steps=[1000, 2000, 3000])
    search.optimize()
    budgets = {}
    for experiment in runs.experiments:
        value = experiment.evolution.mut_v
        budgets.setdefault(value, []).append(experiment.budget.total_steps)
    assert all(found == [1000, 2000, 3000][: len(found)] for found in budgets.values())
    states = [trial.state.name for trial in search.finished()]
    assert states.count("PRUNED") == sum(len(found) < 3 for found in budgets.values()) > 0
    best = max(budgets, key=lambda value: -abs(value - BEST_MUT_V))
    assert budgets[best] == [1000, 2000, 3000]
    # The first five are never ended: there is no median to be worse than.
    assert all(len(found) == 3 for found in list(budgets.values())[:5])


def test_settings_that_were_tried_are_not_tried_again(tmp_path, caplog):
    """Nor do they count: a search has as many different trials as it says."""
    params = {
        "evolution.num_children": "choice(5, 10, 20)",
        "evolution.period_episodes": "choice(25, 50)",
    }
    fake = FakeRuns(tmp_path / "fake", rate=lambda e: e.evolution.num_children / 20)
    search, runs = search_of(tmp_path, fake, params=params, num_trials=5)
    search.optimize()
    settings = [
        (e.evolution.num_children, e.evolution.period_episodes) for e in runs.experiments
    ]
    assert len(search.finished()) == len(set(settings)) == len(settings) == 5
    # There are six of them, and then nothing is left to try.
    more, runs = search_of(tmp_path, fake, params=params, num_trials=9)
    more.optimize()
    assert len(more.finished()) == len(runs.experiments) == 6
    assert "every choice that is left was tried: 6 trials" in caplog.text
    assert "repeats" not in search_table(more)


def test_worlds_that_decide_are_not_those_of_reports(tmp_path):
    search, runs = search_of(tmp_path, num_trials=1)
    search.optimize()
    (experiment,) = runs.experiments
    assert experiment.evaluation.seed != load_experiment([]).evaluation.seed
    assert experiment.evaluation.episodes == 200
    assert experiment.budget.agent_steps is None


@pytest.mark.full
def test_choices_ranges_and_whole_numbers_stay_what_they_are(tmp_path):
    params = {
        "evolution.num_children": "choice(5, 10)",
        "evolution.num_trials": "range(2, 8, step=3)",
        "evolution.period_episodes": "int(interval(20000, 50000))",
        "evolution.mut_v": "tag(log, interval(0.001, 1.0))",
    }
    runs = FakeRuns(tmp_path / "fake", rate=lambda experiment: 0.5)
    search, runs = search_of(tmp_path, runs, params=params, num_trials=10)
    search.optimize()
    evolutions = [experiment.evolution for experiment in runs.experiments]
    assert {e.num_children for e in evolutions} == {5, 10}
    assert {e.num_trials for e in evolutions} == {2, 5}
    assert all(20_000 <= e.period_episodes <= 50_000 for e in evolutions)
    assert any(e.period_episodes % 100 for e in evolutions)
    # Half of logarithmic draws are below the middle of the exponents.
    assert 1 < sum(e.mut_v < 0.0316 for e in evolutions) < 9


def test_an_interrupted_search_goes_on_with_the_trial_that_was_running(tmp_path):
    options = {"num_trials": 4, "total_steps": [1000, 2000]}
    stopped = FakeRuns(tmp_path / "first", stop_at=4)
    search, _ = search_of(tmp_path, stopped, **options)
    with pytest.raises(InterruptedRunError):
        search.optimize()
    assert len(search.finished()) == 1

    again, runs = search_of(tmp_path, FakeRuns(tmp_path / "second"), **options)
    again.optimize()
    assert len(again.finished()) == 4
    interrupted = stopped.experiments[-1].evolution.mut_v
    assert runs.experiments[0].evolution.mut_v == interrupted
    values = [experiment.evolution.mut_v for experiment in runs.experiments]
    assert stopped.experiments[0].evolution.mut_v not in values
    again.optimize()
    assert len(runs.experiments) == len(values), "there is nothing left to do"


def test_the_running_trial_of_another_process_is_left_alone(tmp_path):
    began, may_end = threading.Event(), threading.Event()

    def wait(experiment):
        began.set()
        assert may_end.wait(60)
        return 0.5

    first, waiting = search_of(tmp_path, FakeRuns(tmp_path / "a", rate=wait), num_trials=2)
    worker = threading.Thread(target=first.optimize)
    worker.start()
    assert began.wait(60)
    second, runs = search_of(tmp_path, FakeRuns(tmp_path / "b"), num_trials=2)
    second.optimize()
    may_end.set()
    worker.join(60)
    states = [trial.state.name for trial in second.finished()]
    assert states == ["COMPLETE"] * 2
    assert len(runs.experiments) == 1
    tried = [e.evolution.mut_v for e in (*waiting.experiments, *runs.experiments)]
    assert len(set(tried)) == 2


@pytest.mark.parametrize("kind", ["value", "diverged"])
def test_a_trial_that_fails_does_not_end_the_search(tmp_path, kind):
    error = ValueError("mut_v=2 must be <= 1")
    if kind == "diverged":
        directory = RunDirectory(tmp_path / "run")
        error = TrainingDivergedError(NonFiniteUpdateError(["loss"], None), directory, None)
    runs = FakeRuns(tmp_path / "fake", fail_at=2, error=error)
    search, _ = search_of(tmp_path, runs, num_trials=3)
    search.optimize()
    states = [trial.state.name for trial in search.finished()]
    assert states == ["COMPLETE", "FAIL", "COMPLETE"]
    assert search.finished()[1].user_attrs["error"] == f"{type(error).__name__}: {error}"
    assert search.best().state.name == "COMPLETE"


OF_THE_MACHINE = [
    OSError(errno.ENOSPC, "No space left on device"),
    UnreadableFileError(OSError(errno.EIO, "Input/output error"), Path("config.json")),
    MemoryError("no memory"),
    RunDirectoryError("runs/a is in use by another process"),
    WorkerDiedError("killed"),
    RuntimeError("a fault of the code"),
]


@pytest.mark.parametrize(
    "error",
    full_but(OF_THE_MACHINE[:1], OF_THE_MACHINE),
    ids=lambda error: type(error).__name__,
)
def test_an_error_of_the_machine_ends_the_search_and_its_trial_is_taken_up(tmp_path, error):
    options = {"num_trials": 3}
    broken = FakeRuns(tmp_path / "first", fail_at=2, error=error)
    search, _ = search_of(tmp_path, broken, **options)
    with pytest.raises(type(error), match=re.escape(str(error))):
        search.optimize()
    assert len(broken.experiments) == 2, "it tried no other trial"
    assert [trial.state.name for trial in search.finished()] == ["COMPLETE"]
    again, runs = search_of(tmp_path, FakeRuns(tmp_path / "second"), **options)
    again.optimize()
    assert [trial.state.name for trial in again.finished()] == ["COMPLETE"] * 3
    taken_up = broken.experiments[-1].evolution.mut_v
    assert runs.experiments[0].evolution.mut_v == taken_up


def test_a_result_that_cannot_be_read_is_not_held_against_settings(tmp_path):
    runs = FakeRuns(tmp_path / "fake", rate=lambda experiment: "high")
    search, _ = search_of(tmp_path, runs)
    with pytest.raises(ValueError, match="success_rate='high'"):
        search.optimize()
    assert search.finished() == []


@pytest.mark.parametrize("kept", full_but([10], [1, 10, -2]))
def test_a_journal_whose_last_line_was_cut_goes_on(tmp_path, kept, caplog):
    search, _ = search_of(tmp_path, FakeRuns(tmp_path / "a"), num_trials=2)
    search.optimize()
    journal = search.folder / "search.journal"
    *whole, last = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(whole) + last[:kept])
    for num_trials in (3, 4):
        runs = FakeRuns(tmp_path / f"b{num_trials}")
        again, _ = search_of(tmp_path, runs, num_trials=num_trials)
        again.optimize()
        assert len(again.finished()) == num_trials
    assert "a line that was cut" in caplog.text
    assert all(json.loads(line) for line in journal.read_text().splitlines())


def test_a_journal_is_whole_after_a_disk_that_took_a_part(tmp_path, monkeypatch):
    search, _ = search_of(tmp_path, FakeRuns(tmp_path / "a"), num_trials=1)
    search.optimize()
    whole = (search.folder / "search.journal").read_bytes()

    def write_part(file, content):
        file.write(content[:7])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(search_journal, "_write_all", write_part)
        with pytest.raises(OSError, match="No space left"):
            search_of(tmp_path, FakeRuns(tmp_path / "b"), num_trials=2)[0].optimize()
    assert (search.folder / "search.journal").read_bytes() == whole


def test_a_damaged_journal_is_named(tmp_path):
    search, _ = search_of(tmp_path, num_trials=1)
    search.optimize()
    journal = search.folder / "search.journal"
    journal.write_bytes(b"no line of a journal\n" + journal.read_bytes())
    with pytest.raises(ValueError, match=r"search\.journal is damaged.*move it away"):
        search_of(tmp_path, num_trials=2)


@pytest.mark.parametrize("storage", full_but(["journal"], ["journal", "sqlite"]))
def test_a_search_writes_through_no_link(tmp_path, storage):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    folder = tmp_path / "runs" / "search"
    folder.mkdir(parents=True)
    for name in (".search.lock", f"search.{storage}", ".trial_0.lock"):
        (folder / name).symlink_to(outside)
        with pytest.raises(OSError, match="is a link"):
            search_of(tmp_path, storage=storage)[0].optimize()
        (folder / name).unlink()
        assert outside.read_text() == "mine"


def test_another_question_begins_anew_and_more_trials_do_not(tmp_path):
    search, _ = search_of(tmp_path, FakeRuns(tmp_path / "a"), num_trials=2)
    search.optimize()
    more, runs = search_of(tmp_path, FakeRuns(tmp_path / "b"), num_trials=3)
    more.optimize()
    assert len(runs.experiments) == 1
    other, _ = search_of(tmp_path, FakeRuns(tmp_path / "c"), seeds=[1])
    assert other.finished() == []


@pytest.mark.parametrize("name", full_but(["grainbow_indoor", "ppo_water"], SEARCHES))
def test_every_search_can_run_its_first_and_last_values(name):
    search = load_search([f"+search={name}"])
    assert search.name == f"search_{name}"
    assert search.overrides
    for end in (0, -1):
        chosen = []
        for param, choices in search.params.items():
            values = choices.rpartition("(")[2].strip(")").split(",")
            chosen.append(f"{param}={values[end].strip()}")
        load_experiment([*search.overrides, *chosen])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "must be given once"),
        (["+search=nothing"], r"\+search=nothing must be one of"),
        (["search=gpo_water"], r"did you mean \+search=gppo_water"),
        (["+search=gppo_water", "+search.fuel=1"], r"\+search.fuel=1 must be an option"),
        (["+search=gppo_water", "search.num_trials=1e1"], "write 10"),
        (["+search=gppo_water", "search.seeds=["], "must be name=value"),
        (["+search=gppo_water", "search.num_trials=0"], "num_trials=0"),
        (["+search=gppo_water", "search.storage=redis"], "storage='redis'"),
        (["+search=gppo_water", "search.total_steps=[2,1]"], "ascending"),
        (["+search=gppo_water", "search.params=null"], "params"),
        (["+search=gppo_water", "search.unknown=1"], "search.unknown=1 must be an option"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        load_search(arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"params": {"evolution.mut_v": "0.1"}}, "nothing to choose from"),
        ({"params": {"evolution.mut_v": "choice("}}, "must be name=value"),
        ({"overrides": ["experiment=nothing"]}, "nothing"),
        ({"overrides": ["toy=true"]}, "toy=true"),
    ],
)
def test_a_search_that_cannot_work_is_refused_before_its_first_trial(
    tmp_path, options, message
):
    with pytest.raises(Exception, match=message):
        search_of(tmp_path, **options)


@pytest.mark.full
def test_the_command_trains_and_prints_the_best_overrides_last(tmp_path):
    command = [
        SCRIPTS / "gdrl-search",
        "+search=gppo_water",
        "search.num_trials=2",
        "search.total_steps=[1000,5000]",
        "search.episodes=2",
        "search.seeds=[0]",
        "task.step_limit=60",
        "network.actor_cells=[16, 16]",
        "algorithm.frames_per_batch=512",
        "algorithm.num_epochs=1",
        f"runs_dir={tmp_path}",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    *table, best = done.stdout.strip().splitlines()
    assert len(table) == 2
    assert best.startswith("gdrl-train experiment=gppo_water ")
    assert " task.step_limit=60 " in best
    # As a shell takes it.
    found = load_experiment(shlex.split(best)[1:])
    assert found.network.actor_cells == [16, 16]
    evaluations = list(tmp_path.rglob("evaluation.json"))
    assert len(evaluations) == 2
    records = [json.loads(path.read_text()) for path in evaluations]
    assert all(record["total_steps"] >= 5000 for record in records)
    configs = [
        json.loads((path.parent / "config.json").read_text()) for path in evaluations
    ]
    assert dataclasses.asdict(found.evolution) in [c["evolution"] for c in configs]
