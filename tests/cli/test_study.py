"""The command of studies: what it takes, refuses and tells; killed and shared for real."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gdrl_torchrl.cli.shared.compose import load_experiment
from gdrl_torchrl.cli.shared.names import names_in
from gdrl_torchrl.cli.study import load_study, main
from gdrl_torchrl.studies.results import StudyResults
from gdrl_torchrl.studies.study import Study
from tests.small import tiny_options


def as_list(overrides):
    return "[" + ",".join(f"'{override}'" for override in overrides) + "]"


TINY_PILOT = [
    "study=pilot",
    f"study.tasks.near={as_list(['task=water', 'task.sea=calm'])}",
    *(
        f"study.methods.{method}.overrides={as_list(tiny_options(experiment))}"
        for method, experiment in (
            ("ppo", "ppo_water"),
            ("gppo", "gppo_water"),
            ("rainbow", "rainbow_indoor"),
            ("grainbow", "grainbow_indoor"),
        )
    ),
    "study.total_steps={near:400,paper:400}",
    "study.seeds=[5,6]",
    "study.num_policies=3",
    "study.episodes=2",
]


@pytest.mark.parametrize("name", names_in("study"))
def test_every_study_that_is_shipped_can_be_run(name, tmp_path):
    config, _ = load_study([f"study={name}"])
    assert config.name == name, "its results are found by the name that it is asked for by"
    study = Study(config, tmp_path, load_experiment, [f"runs_dir={tmp_path}"])
    assert study.missing() == study.jobs
    assert "waiting" in study.status()
    assert not list(tmp_path.iterdir()), "to look changes nothing"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "study=<name> must be given once"),
        (["study=pilto"], "did you mean study=pilot?"),
        (["study=pilot", "workers=0"], "workers=0 must be"),
        (["study=pilot", "workers=two"], "workers=two must be a whole number"),
        (["study=pilot", "seed=1"], "seed=1 must be one of"),
        (["study=pilot", "study.sedes=[1]"], "study.sedes"),
        (["study=pilot", "study.seeds=[1,1]"], "must not hold a seed twice"),
        (["study=pilot", "core=99999"], "core=99999 must be"),
    ],
)
def test_a_mistake_is_one_line(arguments, said, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["gdrl-study", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    (line,) = str(ended.value).splitlines()
    assert line.startswith("error: ")
    assert said in line


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_switch_may_stand_anywhere(place, monkeypatch, tmp_path, capsys):
    arguments = ["study=pilot", f"results={tmp_path}"]
    arguments.insert(place, "--status")
    monkeypatch.setattr(sys, "argv", ["gdrl-study", *arguments])
    main()
    assert "5 waiting" in capsys.readouterr().out


def working(folder, *options):
    return subprocess.Popen(
        [sys.executable, "-m", "gdrl_torchrl.cli.study", *TINY_PILOT, *options],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def rows_of(folder: Path):
    results = StudyResults(folder / "results" / "pilot")
    found = [*results.runs(), *results.curves()]
    return [{n: v for n, v in row.items() if n != "wall_s"} for row in found]


@pytest.mark.full
def test_a_study_killed_twice_and_shared_by_two_ends_as_an_undisturbed_one(tmp_path):
    whole, pieces = tmp_path / "whole", tmp_path / "pieces"
    whole.mkdir(), pieces.mkdir()
    undisturbed = working(whole)
    printed, said = undisturbed.communicate(timeout=600)
    assert undisturbed.returncode == 0, said
    assert printed.strip().endswith("pilot")
    for runs in (1, 4):
        process = working(pieces)
        deadline = time.monotonic() + 120.0
        while time.monotonic() < deadline:
            done = len(list(pieces.glob("runs/*/*/*/DONE")))
            begun = len(list(pieces.glob("runs/*/*/*/metrics.csv")))
            if done >= runs and begun > done:
                break
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    both = working(pieces, "workers=2")
    printed, said = both.communicate(timeout=600)
    assert both.returncode == 0, said
    assert "Traceback" not in said
    assert len(rows_of(whole)) == 8 + 8 * 3
    assert rows_of(pieces) == rows_of(whole)
