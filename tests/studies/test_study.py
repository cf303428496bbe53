"""A study at work: interrupted, shared, and the same whoever has run it."""

from __future__ import annotations

import csv
import signal

import pytest

from gdrl_torchrl.agents.update import NonFiniteUpdateError
from gdrl_torchrl.cli.evaluate import evaluate_run
from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.evaluation import read_curve, read_evaluation
from gdrl_torchrl.runs.errors import InterruptedRunError, TrainingDivergedError
from gdrl_torchrl.runs.place import directory_of
from gdrl_torchrl.runs.run import run_experiment
from gdrl_torchrl.studies.results import job_of
from gdrl_torchrl.studies.study import Study
from tests.small import compose, toy_study

pytestmark = pytest.mark.usefixtures("without_figures")


ELSEWHERE = {
    "easy": {"farther": ["task.goal_distance_m=[2,4]"], "wild": ["task.sea=rough"]}
}


def study_of(folder, load=compose, **options):
    config = toy_study(**{"elsewhere": ELSEWHERE, **options})
    return Study(config, folder / "results", load, [f"runs_dir={folder / 'runs'}"])


def without_time(rows):
    return [{n: v for n, v in row.items() if n != "wall_s"} for row in rows]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gdrl_torchrl.pictures.figures.draw_learning_curve", lambda run: None)
        patch.setattr("gdrl_torchrl.pictures.figures.draw_trajectories", lambda run: None)
        study = study_of(tmp_path_factory.mktemp("undisturbed"), load_experiment)
        assert study.work(run_experiment) == []
    return study


def test_results_are_those_of_the_runs(undisturbed):
    rows = undisturbed.results.runs()
    assert len(rows) == 4
    for job, row in zip(sorted(undisturbed.jobs), rows, strict=True):
        config = undisturbed.config_of(job)
        path = directory_of(config).path
        told, curve = read_evaluation(path), read_curve(path)
        assert row["success_rate"] == told["success_rate"]
        assert row["success_rate_sampled"] == told["success_rate_sampled"]
        assert row["area"] == pytest.approx(sum(p["success_rate"] for p in curve) / 4)
        assert row["total_steps"] >= 400 > row["total_steps"] - 150
        assert config.seed == row["seed"]
        assert config.evolution.enabled == (row["method"] == "gppo")
    curves = undisturbed.results.curves()
    assert [row["point"] for row in curves] == [1, 2, 3, 4] * 4
    for row in curves:
        assert 0 <= row["total_steps"] <= 100 * row["point"], "what the run had by its mark"
    assert all(one["total_steps"] > 100 for one in curves if one["point"] == 4)


def test_final_policies_are_evaluated_in_other_worlds_as_by_the_command(undisturbed):
    rows = undisturbed.results.elsewhere()
    assert len(rows) == 4 * 2
    for row in rows:
        job = next(job for job in undisturbed.jobs if job == job_of(row))
        run = directory_of(undisturbed.config_of(job)).path
        (override,) = ELSEWHERE["easy"][row["worlds"]]
        told = evaluate_run([f"run={run}", override])
        names = ("success_rate", "success_rate_sampled", "collision_rate", "timeout_rate")
        assert {n: row[n] for n in names} == {n: told[n] for n in names}


def test_a_policy_that_could_not_act_elsewhere_is_refused_before_anything_is_run(tmp_path):
    given = {"easy": {"seeing": ["task.extra_observations=[velocity]"]}}
    with pytest.raises(ValueError, match=r"elsewhere\.easy\.seeing: .* was trained with"):
        study_of(tmp_path, elsewhere=given)


@pytest.mark.full
def test_a_study_that_was_interrupted_twice_ends_as_an_undisturbed_one(
    undisturbed, tmp_path
):
    def interrupted(config, overrides):
        # The run has ended, and the process is gone before its results are noted.
        path = run_experiment(config, overrides)
        raise InterruptedRunError(signal.SIGTERM, path)

    for _ in range(2):
        with pytest.raises(InterruptedRunError):
            study_of(tmp_path).work(interrupted)
    study = study_of(tmp_path)
    assert study.work(run_experiment) == []
    mine, other = study.results, undisturbed.results
    assert without_time(mine.runs()) == without_time(other.runs())
    assert without_time(mine.curves()) == without_time(other.curves())
    assert mine.elsewhere() == other.elsewhere()
    assert mine.protocol() == other.protocol()
    # Once more: nothing is left to be done.
    assert study_of(tmp_path).work(interrupted) == []


def test_what_has_results_is_not_run_again_on_another_machine(undisturbed, tmp_path):
    first = undisturbed.results.runs()[0]
    study = study_of(tmp_path)
    study.results.begin(study.protocol)
    study.results.add(first, [])
    ran = []

    def note(config, overrides):
        ran.append((config.algorithm_label, config.seed))
        return directory_of(
            undisturbed.config_of(next(j for j in undisturbed.jobs if named(j) == ran[-1]))
        ).path

    def named(job):
        return (job.method, job.seed)

    assert study.work(note) == []
    assert (first["method"], first["seed"]) not in ran
    assert len(ran) == 3
    assert without_time(study.results.runs()) == without_time(undisturbed.results.runs())


def test_runs_that_another_process_is_at_are_left_to_it(undisturbed, tmp_path):
    study = study_of(tmp_path)
    held = study.jobs[1]
    place = directory_of(study.config_of(held))

    def run_what_is_held(config, overrides):
        """The other runs there are, where nobody disturbed them."""
        if directory_of(config).path == place.path:
            return run_experiment(config, overrides)
        chosen = next(j for j in study.jobs if study.config_of(j) == config)
        return directory_of(undisturbed.config_of(chosen)).path

    with place.locked():
        assert "1 running" in study.status()
        assert study.work(run_what_is_held) == [held]
    assert [job for job in study.jobs if job not in study.results.jobs()] == [held]
    assert "about" in study.status()
    assert study.work(run_what_is_held) == []
    assert without_time(study.results.runs()) == without_time(undisturbed.results.runs())


def test_a_run_that_diverges_counts_as_no_success_and_an_error_of_the_machine_does_not(
    tmp_path,
):
    study = study_of(tmp_path)

    def diverging(config, overrides):
        path = directory_of(config)
        path.path.mkdir(parents=True, exist_ok=True)
        raise TrainingDivergedError(NonFiniteUpdateError(["loss"], None), path, None)

    def full_disk(config, overrides):
        raise RunDirectoryError("No space left on device")

    with pytest.raises(RunDirectoryError):
        study.work(full_disk)
    assert study.results.runs() == []
    assert study.work(diverging) == []
    rows = study.results.runs()
    assert {row["state"] for row in rows} == {"failed"}
    assert {row["area"] for row in rows} == {0.0}
    assert {row["success_rate"] for row in study.results.elsewhere()} == {0.0}
    assert len(study.results.elsewhere()) == 4 * 2
    assert all("loss" in row["error"] for row in rows)


def test_numbers_are_written_by_the_study_alone(undisturbed):
    with open(undisturbed.results.folder / "runs.csv") as file:
        rows = list(csv.DictReader(file))
    assert all(len(row["digest"]) == 12 for row in rows)
    assert {row["protocol"] for row in rows} == {undisturbed.results.protocol()[1][:12]}


def test_a_study_of_toy_runs_is_refused(tmp_path):
    with pytest.raises(ValueError, match="toy=true takes sizes of its own"):
        study_of(tmp_path, tasks={"easy": ["task=water", "toy=true"]})
