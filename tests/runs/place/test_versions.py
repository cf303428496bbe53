"""A run of another version, of other sources or with other packages."""

from __future__ import annotations

import json

import pytest

from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.runs.run import run_experiment
from tests.marks import full_but

pytestmark = pytest.mark.usefixtures("without_figures")


@pytest.mark.parametrize("finished", full_but([False], [True, False]))
def test_a_run_of_another_version_of_runs_needs_force(finished, tiny, monkeypatch, rows_of):
    path = run_experiment(tiny("budget.agent_steps=40"))
    for module in ("run", "place"):
        monkeypatch.setattr(f"gdrl_torchrl.runs.{module}.RUN_VERSION", 99)
    steps = 40 if finished else 80
    before = (path / "metrics.csv").read_bytes()
    with pytest.raises(RunDirectoryError, match="force=true") as refused:
        run_experiment(tiny(f"budget.agent_steps={steps}"))
    assert "version 99" in str(refused.value)
    assert str(path) in str(refused.value)
    assert (path / "metrics.csv").read_bytes() == before
    assert run_experiment(tiny(f"budget.agent_steps={steps}", "force=true")) == path
    assert rows_of(path)[-1]["agent_steps"] == str(steps)


def test_a_run_of_before_there_were_versions_needs_force(tiny):
    path = run_experiment(tiny("budget.agent_steps=40"))
    for name in ("DONE", "provenance.json"):
        content = json.loads((path / name).read_text())
        del content["version"]
        (path / name).write_text(json.dumps(content))
    with pytest.raises(RunDirectoryError, match=r"version 0 of runs.*force=true"):
        run_experiment(tiny("budget.agent_steps=40"))


def test_other_sources_do_not_stop_a_run_and_are_noted(tiny, monkeypatch, rows_of, caplog):
    path = run_experiment(tiny("budget.agent_steps=40"))
    first = json.loads((path / "provenance.json").read_text())
    assert first["before"] == []
    other = "gdrl_torchrl.runs.place.code_version"
    monkeypatch.setattr(other, lambda: "9.9+other")
    assert run_experiment(tiny("budget.agent_steps=80")) == path
    assert rows_of(path)[-1]["agent_steps"] == "80"
    then = json.loads((path / "provenance.json").read_text())
    assert then["code"] == "9.9+other"
    assert [known["code"] for known in then["before"]] == [first["code"]]
    assert "was written with" not in caplog.text


def test_other_packages_are_named_in_a_warning_and_the_run_goes_on(tiny, rows_of, caplog):
    path = run_experiment(tiny("budget.agent_steps=40"))
    file = path / "provenance.json"
    content = json.loads(file.read_text())
    installed = content["packages"]["mujoco"]
    content["packages"] |= {"torch": "1.0.0", "numpy": "1.2.3"}
    file.write_text(json.dumps(content))
    assert run_experiment(tiny("budget.agent_steps=80")) == path
    assert rows_of(path)[-1]["agent_steps"] == "80"
    (said,) = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert "torch 1.0.0 (now " in said
    assert "numpy 1.2.3 (now " in said
    assert installed not in said
    assert json.loads(file.read_text())["packages"]["torch"] != "1.0.0"
