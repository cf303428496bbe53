"""Sweeps as a user runs them: which jobs they make, and what becomes of them."""

from __future__ import annotations

import copy
import functools
import os
import signal
import subprocess
import sysconfig
import time
from importlib import resources
from pathlib import Path

import pytest
from hydra import compose, initialize_config_module
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from gdrl_torchrl.cli.shared.compose import (
    CONFIG_MODULE,
    composed,
    load_experiment,
    register_configs,
    to_experiment,
)
from gdrl_torchrl.cli.train import check_launcher
from gdrl_torchrl.files.run_table import find_runs, run_row
from gdrl_torchrl.runs.place import directory_of
from tests.marks import full_but

SCRIPTS = Path(sysconfig.get_path("scripts"))
CONF = resources.files("gdrl_torchrl.conf")
SWEEPS = sorted(
    entry.name.removesuffix(".yaml") for entry in CONF.joinpath("sweep").iterdir()
)
QUESTIONS = {
    "mutation_reading",
    "mutation_std",
    "mutation_schedule",
    "population_size",
    "trials",
    "period",
    "hand_over",
    "experience_share",
    "tie_rule",
    "fitness",
    "network_width",
    "num_beams",
    "goal_tolerance",
    "wave_height",
}
QUICK = ("mutation_std", "population_size", "network_width", "paper_water")
"""A number, a number that others depend on, a list, and files of several groups."""
SMALL = ("toy=true", "budget.total_steps=1000", "evaluation.episodes=2")


def sweep_config(name):
    register_configs()
    with initialize_config_module(CONFIG_MODULE, version_base="1.3"):
        return compose("config", overrides=[f"+sweep={name}"], return_hydra_config=True)


def jobs_of(name):
    """Overrides of every job, as Hydra's own sweeper splits the axes."""
    params = OmegaConf.to_container(sweep_config(name).hydra.sweeper.params)
    texts = [f"{key}={value}" for key, value in params.items()]
    parsed = OverridesParser.create().parse_overrides(texts)
    (batch,) = BasicSweeper.split_arguments(parsed, max_batch_size=None)
    return [list(job) for job in batch]


@functools.cache
def config_of_files(name, files):
    """A sweep's configuration with the files that a job chooses."""
    return composed("config", [f"+sweep={name}", *files])


def config_of_job(name, job):
    """A job's configuration; composing takes long, and many jobs choose the same files."""
    files = tuple(override for override in job if "." not in override.partition("=")[0])
    values = [override for override in job if override not in files]
    base = copy.deepcopy(config_of_files(name, files))
    for option, _, value in (override.partition("=") for override in values):
        OmegaConf.update(base, option, OmegaConf.create(f"value: {value}").value)
    return to_experiment(base)


def test_there_is_a_sweep_for_every_question_and_comparison():
    assert set(SWEEPS) >= QUESTIONS | {"smoke", "paper_indoor", "paper_water"}


@pytest.mark.parametrize("name", SWEEPS)
def test_a_sweep_is_named_as_its_file_and_names_its_launcher(name):
    config = sweep_config(name)
    assert config.name == name
    assert "BasicLauncher" in config.hydra.launcher._target_


@pytest.mark.parametrize("name", full_but(QUICK, SWEEPS))
def test_every_job_of_a_sweep_is_valid_and_has_a_directory_of_its_own(name):
    jobs = jobs_of(name)
    assert len(jobs) > 2
    # Seeds differ in nothing but the last part of the path: one of each is enough.
    first = [job for job in jobs if not any("seed=" in o and o != "seed=0" for o in job)]
    configs = [config_of_job(name, job) for job in first]
    paths = {directory_of(config).path for config in configs}
    assert len(paths) == len(first)
    assert all(path.parts[1] == name for path in paths)


def test_the_smoke_sweep_has_every_experiment():
    experiments = {
        entry.name.removesuffix(".yaml") for entry in CONF.joinpath("experiment").iterdir()
    }
    assert {job[0] for job in jobs_of("smoke")} == {f"experiment={e}" for e in experiments}


def test_a_launcher_that_breaks_runs_is_refused_with_the_reason():
    with pytest.raises(ValueError, match="loky"):
        check_launcher("hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher")


def sweep(folder, *overrides, **kwargs):
    return subprocess.Popen(
        [SCRIPTS / "gdrl-train", "-m", *overrides, *SMALL, f"runs_dir={folder}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **kwargs,
    )


def finished(folder):
    return [run / "DONE" for run in find_runs(folder) if (run / "DONE").exists()]


@pytest.mark.full
def test_a_killed_sweep_goes_on_and_a_failing_job_does_not_stop_the_others(tmp_path):
    # The second job is impossible, the others are not.
    axes = ("experiment=ppo_water,grainbow_water", "task.actions=continuous", "seed=0,1,2")
    first = sweep(tmp_path, *axes)
    for _ in range(600):
        done = finished(tmp_path)
        if done:
            break
        time.sleep(0.1)
    first.send_signal(signal.SIGTERM)
    first.communicate(timeout=120)
    assert first.returncode != 0
    assert done
    assert len(finished(tmp_path)) < 3, "the signal ended the whole sweep"
    stamps = {path: os.stat(path).st_mtime_ns for path in finished(tmp_path)}

    second = sweep(tmp_path, *axes)
    printed, said = second.communicate(timeout=300)
    assert second.returncode != 0, "a job failed"
    assert "give task.actions=discrete" in said
    runs = find_runs(tmp_path)
    assert [run_row(run)["state"] for run in runs] == ["done"] * 3
    assert len(printed.split()) == 3
    assert "Traceback" not in said
    assert said.splitlines()[-1].startswith(
        "error: jobs that failed: 3, the last one: job 5"
    )
    assert {path: os.stat(path).st_mtime_ns for path in stamps} == stamps, "not run again"


@pytest.mark.full
def test_jobs_in_other_processes_tell_their_directories_and_their_errors(tmp_path):
    axes = ("experiment=ppo_water,grainbow_water", "task.actions=continuous")
    job = sweep(tmp_path, *axes, "hydra/launcher=submitit_local")
    printed, said = job.communicate(timeout=300)
    assert job.returncode == 1, "a job failed"
    assert "give task.actions=discrete" in said
    assert "Traceback" not in said
    (run,) = find_runs(tmp_path)
    assert run_row(run)["state"] == "done"
    assert printed == f"{run}\n"
    # A pickled result of each process.
    assert len(list(tmp_path.rglob(".submitit/*/*_result.pkl"))) == 2
    assert not list(tmp_path.rglob(".jobs"))


@pytest.mark.full
def test_a_run_that_another_process_holds_is_passed_over(tmp_path):
    axes = ("experiment=ppo_water", "seed=0,1")
    overrides = [axes[0], "seed=0", *SMALL, f"runs_dir={tmp_path}"]
    held = directory_of(load_experiment(overrides))
    with held.locked():
        job = sweep(tmp_path, *axes)
        printed, said = job.communicate(timeout=300)
    assert job.returncode == 0, said
    assert f"skipped: {held.path} runs elsewhere" in said
    assert "Traceback" not in said
    assert printed == f"{held.path.with_name('seed_1')}\n"
    job = sweep(tmp_path, *axes)
    printed, said = job.communicate(timeout=300)
    assert job.returncode == 0
    assert [Path(line).name for line in printed.split()] == ["seed_0", "seed_1"]


@pytest.mark.full
def test_the_same_sweep_in_many_processes_is_a_queue(tmp_path):
    axes = ("experiment=ppo_water", "seed=0,1,2,3")
    jobs = [sweep(tmp_path, *axes) for _ in range(2)]
    told = [job.communicate(timeout=300)[1] for job in jobs]
    assert [job.returncode for job in jobs] == [0, 0], told
    assert not any("Traceback" in said for said in told)
    runs = find_runs(tmp_path)
    assert [run_row(run)["state"] for run in runs] == ["done"] * 4
    # A run that both had trained would be evaluated twice.
    assert sum(said.count("held-out success") for said in told) == 4
