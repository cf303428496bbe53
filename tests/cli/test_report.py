"""``gdrl-report``: what it writes, and what it says of mistakes."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gdrl_torchrl.cli.report import main, report, values_in
from tests.reports.invented import write_study


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "nothing: one of study=, runs= and fill= must be given"),
        (
            ["study=a", "runs=b"],
            "study=a runs=b: one of study=, runs= and fill= must",
        ),
        (
            ["studies=a"],
            "studies=a must be one of study=..., runs=..., fill=..., results=..., out=...",
        ),
        (["study="], "study= must be one of study=..., runs=..., fill=..., results=..."),
        (["study=a", "study=b"], "study=b must be given once"),
        (["runs=a", "results=b"], "results=b must not be given beside runs="),
        (["fill=a", "out=b"], "out=b must not be given beside fill="),
    ],
)
def test_a_mistake_is_named(arguments, said):
    with pytest.raises(ValueError, match="must") as error:
        values_in(arguments)
    assert said in str(error.value)


def test_a_study_without_results_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["gdrl-report", "study=pilot", f"results={tmp_path}"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert str(ended.value).startswith("error: study=pilot must be a study with results")
    assert "\n" not in str(ended.value)


def test_a_folder_without_runs_is_named(tmp_path):
    with pytest.raises(ValueError, match="must have a run below it that has ended"):
        report({"runs": str(tmp_path)})


def test_help_and_mistakes_need_nothing_that_takes_long():
    code = (
        "import sys; import gdrl_torchrl.cli.report; "
        "print(sorted({'torch', 'scipy', 'matplotlib', 'hydra'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_one_run_a_method_and_no_hypothesis_make_a_page_where_it_is_asked_for(tmp_path):
    study = write_study(tmp_path, seeds=range(1), hypotheses=[])
    out = tmp_path / "page"
    page = report({"study": study.name, "results": str(study.parent), "out": str(out)})
    assert page == out / "report.html"
    assert (out / "report.md").is_file()
    assert 'id="scores"' in page.read_text()
    assert 'id="hypotheses"' not in page.read_text()
