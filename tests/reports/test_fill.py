"""Figures in a text: those of the results, and nothing else of it changes."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from gdrl_torchrl.reports.fill import ARM_FIGURES, fill_files, filled
from tests.reports.invented import METHODS, write_study

ROOT = Path(__file__).parents[2]
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def mark(figure, between="?", **fields):
    said = " ".join(f"{name}={value}" for name, value in fields.items())
    return f"<!-- gdrl study=invented {said} figure={figure} -->{between}<!-- / -->"


def figure_of(study, figure, **fields):
    text = filled(f"before {mark(figure, **fields)} after", study.parent)
    found = re.fullmatch(r"before <!-- gdrl [^>]*-->(.*)<!-- / --> after", text, re.DOTALL)
    return found[1]


def column(study, method, name):
    with open(study / "runs.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["method"] == method]
    return np.array([float(row[name]) for row in rows])


def test_figures_of_a_method_are_those_of_its_rows(study):
    of = {"task": "near", "method": "gppo"}
    areas = column(study, "gppo", "area")
    assert figure_of(study, "runs", **of) == "8"
    assert figure_of(study, "score", **of) == f"{areas.mean():.3f}"
    assert figure_of(study, "sd", **of) == f"{np.std(areas, ddof=1):.3f}"
    success = column(study, "gppo", "success_rate").mean()
    assert figure_of(study, "success", **of) == f"{success:.3f}"
    steps = column(study, "gppo", "population_steps").mean()
    assert figure_of(study, "population_steps", **of) == f"{steps:,.0f}"
    # Of a run that failed they are zero successes, and no costs.
    failed = {"task": "near", "method": "ppo"}
    assert (
        figure_of(study, "score", **failed) == f"{column(study, 'ppo', 'area').mean():.3f}"
    )
    assert figure_of(study, "agent_steps", **failed) == "200,000"


@pytest.mark.parametrize("figure", ARM_FIGURES)
def test_every_figure_of_a_method_is_a_short_text(study, figure):
    assert 0 < len(figure_of(study, figure, task="paper", method="rainbow")) < 30


def test_figures_of_two_methods_are_those_of_their_tests(study):
    pair = {"task": "near", "method": "gppo", "against": "ppo"}
    x, y = (column(study, method, "area") for method in ("gppo", "ppo"))
    wins = stats.mannwhitneyu(x, y).statistic / (len(x) * len(y))
    assert figure_of(study, "improvement", **pair).startswith(
        f"{wins:.2f}\N{NO-BREAK SPACE}["
    )
    difference = x.mean() - y.mean()
    assert figure_of(study, "difference", **pair).startswith(f"{difference:.3f}")
    assert figure_of(study, "decision", **pair) in ("supported", "not supported")


def test_tables_have_a_row_a_method_and_can_be_of_one_task(study):
    whole = figure_of(study, "reached").strip().splitlines()
    assert [line.count("|") for line in whole] == [8] * 6
    water = figure_of(study, "reached", task="near").strip().splitlines()
    assert water == [whole[0], whole[1], *(line for line in whole if "| near |" in line)]
    assert "gppo" in figure_of(study, "hypotheses")
    assert "rough" in figure_of(study, "elsewhere", task="near")


def test_a_table_of_some_methods_has_their_baselines_too(tmp_path):
    study = write_study(tmp_path, baseline={"near": "ppo", "paper": "rainbow"})
    whole = figure_of(study, "summary").strip().splitlines()
    assert [line.split(" | ")[1] for line in whole[2:]] == list(METHODS)
    some = figure_of(study, "summary", methods="grainbow").strip().splitlines()
    assert some == [*whole[:2], *(line for line in whole if "| paper |" in line)]
    areas = [column(study, name, "area") for name in ("grainbow", "rainbow")]
    difference = areas[0].mean() - areas[1].mean()
    base, other = (line.split(" | ") for line in some[2:])
    assert base[3] == f"{areas[1].mean():.3f}"
    assert base[5] == "–"
    assert other[5].startswith(f"{difference:.3f} ")
    both = figure_of(study, "reached", methods="ppo,rainbow", task="near")
    assert both.count("\n| near |") == 1


def test_methods_by_task_have_means_and_their_improvement_over_the_baseline(tmp_path):
    study = write_study(tmp_path, baseline={"near": "ppo"})
    head, _, *rows = figure_of(study, "by_task").strip().splitlines()
    assert head == "| method | near | paper |"
    cells = {name: found for name, *found in (row[2:-2].split(" | ") for row in rows)}
    mean = {name: f"{column(study, name, 'area').mean():.3f}" for name in METHODS}
    wins = figure_of(study, "improvement", task="near", method="gppo", against="ppo")
    assert cells["ppo"] == [mean["ppo"], "–"]
    assert (
        cells["gppo"][0].replace("\\", "") == f"{mean['gppo']} ({' '.join(wins.split())})"
    )
    # A task without a baseline shows the means alone.
    assert cells["grainbow"] == ["–", mean["grainbow"]]


def test_what_was_typed_by_hand_is_replaced_and_the_rest_stays(study, tmp_path):
    of = {"task": "near", "method": "gppo"}
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text(f"# 0.5\n\n{mark('runs', '99', **of)}, {mark('runs', '', **of)} 99\n")
    page.with_name("other.md").write_text("without marks")
    assert fill_files(page.parent, study.parent) == [page]
    assert (
        page.read_text()
        == f"# 0.5\n\n{mark('runs', '8', **of)}, {mark('runs', '8', **of)} 99\n"
    )
    assert fill_files(page, study.parent) == []


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"figure": "runs", "task": "far"}, "task='far' must be one of"),
        ({"figure": "runs", "task": "near", "method": "x"}, "method='x' must be one of"),
        ({"figure": "mean", "task": "near", "method": "ppo"}, "figure='mean' must be one"),
        ({"figure": "runs", "method": "ppo"}, "task=... must be given beside method="),
        ({"figure": "hypotheses", "task": "near"}, "figure='hypotheses' must be one of"),
        ({"figure": "p", "task": "near", "method": "ppo", "against": "gppo"}, "registered"),
        ({"figure": "summary", "methods": "ppo,x"}, "methods='x' must be one of"),
        ({"figure": "runs", "seed": "3"}, "a field of a mark='seed' must be one of"),
    ],
)
def test_a_mark_of_what_there_is_not_is_named_and_no_file_changes(
    study, tmp_path, fields, said
):
    good, bad = tmp_path / "a.md", tmp_path / "b.md"
    good.write_text(mark("runs", task="near", method="ppo"))
    bad.write_text(mark(**fields))
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        fill_files(tmp_path, study.parent)
    assert str(error.value).startswith(f"{bad}: <!-- gdrl study=invented ")
    assert "?" in good.read_text()


@pytest.mark.parametrize("rest", ["", " between ", "never ended"])
def test_a_mark_without_an_end_is_named_and_takes_no_text_with_it(study, rest):
    begun = mark("runs", task="near", method="ppo").removesuffix("<!-- / -->")
    other = mark("runs", task="near", method="gppo") if rest != "never ended" else ""
    with pytest.raises(ValueError, match=r"method=ppo figure=runs -->.* must be ended by"):
        filled(f"{begun}{rest}{other}", study.parent)


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_marked_figures_of_our_texts_are_those_of_the_results(path):
    text = path.read_text(encoding="utf-8")
    assert filled(text, ROOT / "results") == text, "gdrl-report fill=docs (or README.md)"
