"""Packages whose entry points are broken: they are named, and stop nothing else."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from gdrl_tasks import plugins, registry
from gdrl_tasks.checks import check_choice
from gdrl_torchrl.plugins import conf_packages, with_plugins

OFFERS = {
    "gdrl.mutations": "broken_one = broken_package.raises:mutation",
    "gdrl.crossovers": "broken_two = broken_package.exits:crossover",
    "gdrl.algorithms": "broken_three = broken_package:NUMBER\nppo = broken_package:NUMBER",
    "gdrl.tasks": "broken_four = broken_package:NUMBER\npond = broken_package.missing:X",
    "gdrl.conf": "broken_five = broken_package.raises",
}
LOADED_TO_COMPOSE = ("broken_three", "ppo", "broken_four", "pond", "broken_five")


@pytest.fixture
def broken_package(tmp_path):
    """A folder with a package that is installed, and of which nothing works."""
    package = tmp_path / "site" / "broken_package"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("NUMBER = 1\n")
    (package / "raises.py").write_text("raise ValueError('first\\nsecond line')\n")
    (package / "exits.py").write_text("import sys\nsys.exit(3)\n")
    about = tmp_path / "site" / "broken_package-1.5.dist-info"
    about.mkdir()
    about.joinpath("METADATA").write_text(
        "Metadata-Version: 2.1\nName: broken-package\nVersion: 1.5\n"
    )
    points = [f"[{group}]\n{offers}\n" for group, offers in OFFERS.items()]
    about.joinpath("entry_points.txt").write_text("\n".join(points))
    return package.parent


@pytest.fixture
def importable(broken_package, monkeypatch):
    monkeypatch.syspath_prepend(str(broken_package))
    plugins.offers_of.cache_clear()
    registry.registered_tasks.cache_clear()
    yield
    plugins.offers_of.cache_clear()
    registry.registered_tasks.cache_clear()


@pytest.fixture
def command(broken_package, tmp_path):
    def run(module, *arguments):
        return subprocess.run(
            [sys.executable, "-m", f"gdrl_torchrl.cli.{module}", *arguments],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(broken_package)},
            capture_output=True,
            text=True,
            check=False,
        )

    return run


def test_each_is_named_once_with_its_package_and_the_others_go_on(importable, caplog):
    for _ in range(2):
        assert with_plugins({"one": 1}, "gdrl.mutations", needs=("__call__",)) == {"one": 1}
        assert conf_packages() == []
        assert registry.task_names() == ("indoor", "water")
    said = "\n".join(caplog.messages)
    assert len(caplog.messages) == len(said.splitlines()) == 4
    for name in ("broken_one", "broken_four", "pond", "broken_five"):
        assert f"'{name}' of broken-package 1.5 (entry point gdrl." in said
    assert "ValueError: first second line" in said
    assert "it has no name, no options" in said


def test_who_asks_for_one_is_told_what_is_wrong_with_it(importable):
    with pytest.raises(
        ValueError, match=r"must be one of \['indoor', 'water'\]; 'pond' of"
    ):
        registry.make_task("pond")
    offers = with_plugins({"one": 1}, "gdrl.crossovers", needs=("__call__",))
    for value, said in (("broken_two", "SystemExit: 3"), ("other", r"\['one'\]$")):
        with pytest.raises(ValueError, match=said):
            check_choice("crossover", value, offers)


def test_the_name_of_one_of_ours_is_ours(importable):
    offers = with_plugins({"ppo": "ours"}, "gdrl.algorithms", needs=("config",))
    assert offers == {"ppo": "ours"}
    assert "'ppo' of broken-package 1.5" in offers.broken["ppo"]


def test_commands_work_and_name_what_is_broken(command, tmp_path):
    shown = command("train", "--help")
    assert shown.returncode == 0, shown.stderr
    assert "Traceback" not in shown.stderr
    composed = command("train", "experiment=gppo_water", "--cfg", "job")
    assert composed.returncode == 0, composed.stderr
    for name in LOADED_TO_COMPOSE:
        assert f"'{name}' of broken-package 1.5" in composed.stderr
    refused = command("train", "experiment=gppo_water", "evolution.mutation=broken_one")
    assert refused.returncode == 1
    (said,) = [x for x in refused.stderr.splitlines() if "evolution.mutation=" in x]
    assert "'broken_one' of broken-package 1.5" in said


def test_evaluate_blames_the_package_of_a_task_that_is_broken(command, tmp_path):
    (tmp_path / "run").mkdir()
    saved = {
        "task": {"name": "pond"},
        "algorithm": {"name": "ppo"},
        "network": {},
        "evaluation": {},
    }
    (tmp_path / "run" / "config.json").write_text(json.dumps(saved))
    refused = command("evaluate", "run=run")
    assert refused.returncode == 1
    assert "'pond' of broken-package 1.5" in refused.stderr.splitlines()[-1]
    assert "ModuleNotFoundError" in refused.stderr.splitlines()[-1]
