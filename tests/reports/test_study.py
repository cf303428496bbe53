"""What a report says of a study, against counting in its tables."""

from __future__ import annotations

import csv
import math

import numpy as np
import pytest
from scipy import stats

from gdrl_torchrl.reports.of_study import read_study
from gdrl_torchrl.reports.report import sections_of, write_report
from gdrl_torchrl.reports.sections.comparison import beside_baseline_table
from gdrl_torchrl.reports.sections.hypotheses import hypotheses_section, outcomes
from gdrl_torchrl.studies.results import StudyResults
from tests.reports.invented import hypothesis, write_study


def areas(folder, method):
    """Areas of a method's runs, as the table has them."""
    with open(folder / "runs.csv", newline="") as file:
        return [float(r["area"]) for r in csv.DictReader(file) if r["method"] == method]


@pytest.fixture(scope="module")
def tables(study):
    """Rows of the first table of a section with a column, as objects by method."""
    sections = {section.name: section for section in sections_of(read_study(study))}

    def rows(name, column):
        blocks = [b for b in sections[name].blocks if b.kind == "table"]
        table = next(block for block in blocks if column in block.columns)
        return [dict(zip(table.columns, row, strict=True)) for row in table.rows]

    return rows


def test_the_main_table_has_the_interquartile_mean_with_a_crash_as_zero(study, tables):
    rows = {r["method"]: r for r in tables("scores", "IQM of area")}
    for method in ("ppo", "gppo", "rainbow", "grainbow"):
        ordered = sorted(areas(study, method))
        cut = len(ordered) // 4
        middle = np.mean(ordered[cut : len(ordered) - cut])
        assert rows[method]["IQM of area"].startswith(f"{middle:.3f}\N{NO-BREAK SPACE}[")
        worst = np.mean(ordered[: math.ceil(len(ordered) / 4)])
        assert rows[method]["worst quarter of area"] == f"{worst:.3f}"
    assert min(areas(study, "ppo")) == 0.0


def test_costs_are_those_of_runs_that_ended(tables):
    rows = {r["method"]: r for r in tables("scores", "steps in all")}
    assert rows["ppo"]["agent's episodes"] == "2,222"
    assert rows["gppo"]["share of the population"] == "0.40"
    assert rows["gppo"]["switches of evaluations"] == "7.0 of 12.0 (0.58)"
    assert rows["ppo"]["switches of evaluations"] == "–"


def test_missing_and_failed_runs_are_named(tables):
    rows = {r["method"]: r for r in tables("question", "missing")}
    assert (rows["ppo"]["failed"], rows["ppo"]["seeds that ended"]) == (
        "3",
        "7: 0 to 2, 4 to 7",
    )
    assert rows["grainbow"]["missing"] == "7"


def test_methods_with_the_same_runs_are_named_in_a_sentence(tmp_path, study):
    def question(folder):
        return next(
            s for s in sections_of(read_study(folder)) if s.name == "question"
        ).blocks

    whole = question(write_study(tmp_path))
    said = "All 4 pairs of task and method have the same 8 seeds (0 to 7): none failed"
    assert any(b.kind == "text" and b.text.startswith(said) for b in whole)
    assert sum(b.kind == "table" for b in whole) == 1, "nothing differs"
    some = question(study)
    assert any(b.kind == "text" and b.text.startswith("2 of 4 pairs") for b in some)
    (runs,) = (b for b in some if b.kind == "table" and "missing" in b.columns)
    assert [row[1] for row in runs.rows] == ["ppo", "grainbow"]


def test_a_figure_of_a_task_names_the_configurations_of_its_runs_alone(study):
    sections = {s.name: s for s in sections_of(read_study(study))}
    near, paper = (b for b in sections["learning"].blocks if b.kind == "figure")
    assert near.sources[-1] == "configurations on near: ppo aaaa0001, gppo aaaa0002"
    assert "near" not in paper.sources[-1]
    both = next(b for b in sections["scores"].blocks if b.kind == "figure")
    assert both.sources == (*near.sources, paper.sources[-1])


def test_tests_are_scipys_on_the_areas_of_the_table(study):
    (water, indoor) = outcomes(read_study(study))
    for one, pair in ((water, ("gppo", "ppo")), (indoor, ("grainbow", "rainbow"))):
        x, y = (np.array(areas(study, method)) for method in pair)
        expected = stats.ttest_ind(x, y, equal_var=False, alternative="greater").pvalue
        assert one.welch_p == pytest.approx(expected)
        assert one.difference.value == pytest.approx(x.mean() - y.mean())
    larger, smaller = sorted((water.welch_p, indoor.welch_p), reverse=True)
    assert max(water.welch_holm, indoor.welch_holm) == pytest.approx(
        max(larger, 2 * smaller)
    )


def decisions(tmp_path, *hypotheses, **options):
    folder = write_study(tmp_path, hypotheses=list(hypotheses), **options)
    return [one.decision for one in outcomes(read_study(folder))]


def test_decisions_follow_test_direction_and_least_difference(tmp_path):
    given = [
        hypothesis("better", "paper", "grainbow", "rainbow"),
        hypothesis("worse", "paper", "rainbow", "grainbow", "less"),
        hypothesis("other", "paper", "rainbow", "grainbow", "two-sided"),
        hypothesis("the wrong way", "paper", "rainbow", "grainbow"),
        hypothesis("too small", "paper", "grainbow", "rainbow", least=0.9),
    ]
    assert decisions(tmp_path, *given) == [
        "supported",
        "supported",
        "supported",
        "not supported",
        "a difference, but less than the 0.9 that would matter",
    ]


def test_a_decision_before_the_last_run_is_preliminary(study):
    water, indoor = outcomes(read_study(study))
    assert indoor.decision.startswith("preliminary, runs are missing: ")
    assert not water.decision.startswith("preliminary")


@pytest.mark.parametrize("seeds", [range(0), range(1)])
def test_what_nothing_can_be_said_of_is_said(tmp_path, seeds):
    pair = hypothesis("water", "near", "gppo", "ppo")
    assert decisions(tmp_path, pair, seeds=seeds) == ["cannot be tested with these runs"]


def test_all_runs_failed_makes_a_page(tmp_path):
    failed = [(m, s) for m in ("ppo", "gppo", "rainbow", "grainbow") for s in range(3)]
    folder = write_study(tmp_path, seeds=range(3), failed=failed)
    page = write_report(read_study(folder), tmp_path / "page")
    assert "These runs have left no curves." in page.read_text()


def test_the_paper_is_beside_its_own_tasks_and_methods(tables):
    rows = tables("paper", "reward")
    theirs = [(r["task"], r["method"], r["reward"]) for r in rows if r[""] == "paper"]
    assert theirs == [
        ("near", "PPO", "4.5"),
        ("near", "GPPO", "4.8"),
        ("paper", "Rainbow", "36.2"),
        ("paper", "GRainbow", "38.2"),
    ]


def test_success_in_other_worlds_is_beside_that_at_home(study, tables):
    rows = {r["method"]: r for r in tables("elsewhere", "worlds")}
    assert list(rows) == ["ppo", "gppo"], "the other two were evaluated nowhere else"
    with open(study / "runs.csv", newline="") as file:
        rows_of_ppo = [r for r in csv.DictReader(file) if r["method"] == "ppo"]
    home = [float(row["success_rate"]) for row in rows_of_ppo]
    assert rows["ppo"]["worst"] == "0.000", "of the run that failed"
    assert rows["ppo"]["success"].startswith(f"{0.75 * np.mean(home):.3f}")
    assert rows["ppo"]["difference"] == f"{-0.25 * np.mean(home):.3f}"


def test_other_methods_are_shown_beside_the_baseline_of_a_task(tmp_path):
    folder = write_study(tmp_path, leave_out=[("gppo", 3)], baseline={"near": "ppo"})
    sections = {s.name: s for s in sections_of(read_study(folder))}
    tables = [b for b in sections["comparison"].blocks if b.kind == "table"]
    titles = [table.columns for table in tables]
    assert titles == [
        ("task", "method", "baseline", "runs", "difference", "improvement"),
        ("", "rainbow", "grainbow"),
    ], "a task with a baseline has no table of all pairs"
    (row,) = tables[0].rows
    x, y = (np.array(areas(folder, method)) for method in ("gppo", "ppo"))
    assert row[:4] == ("near", "gppo", "ppo", "7, 8")
    interval = stats.ttest_ind(x, y, equal_var=False).confidence_interval(0.95)
    said = f"{x.mean() - y.mean():.3f} [{interval.low:.3f}, {interval.high:.3f}]"
    assert row[4].replace("\N{NO-BREAK SPACE}", " ") == said
    wins = stats.mannwhitneyu(x, y).statistic / (len(x) * len(y))
    assert row[5].startswith(f"{wins:.2f}\N{NO-BREAK SPACE}[")
    drawn = next(b for b in sections["comparison"].blocks if b.kind == "figure")
    (panel,) = drawn.panels
    assert panel.alt == "difference of mean area to ppo on near"
    assert ">gppo<" in panel.svg
    assert ">ppo<" not in panel.svg, "the baseline is the line at zero"


def test_a_baseline_without_runs_is_beside_nothing(tmp_path):
    without = [("ppo", seed) for seed in range(8)]
    folder = write_study(tmp_path, leave_out=without, baseline={"near": "ppo"})
    assert not beside_baseline_table(read_study(folder)).rows
    assert write_report(read_study(folder), tmp_path / "page").exists()


def test_times_to_a_threshold_count_a_crash_as_never(study, tables):
    rows = {r["method"]: r for r in tables("learning", "reached 0.8")}
    with open(study / "curves.csv", newline="") as file:
        reached = {
            r["seed"]
            for r in csv.DictReader(file)
            if r["method"] == "ppo" and float(r["success_rate"]) >= 0.8
        }
    assert rows["ppo"]["reached 0.8"] == f"{len(reached)} of 8"
    assert rows["ppo"]["median steps to 0.8"].startswith("not reached")


def test_success_at_equal_episodes_is_read_from_the_curves_with_all_steps(study, tables):
    rows = {r["method"]: r for r in tables("learning", "agent's episodes")}
    # Of 200,000 steps, 90 an episode, the agent has 0.6 where there is a population.
    assert rows["ppo"]["agent's episodes"] == rows["gppo"]["agent's episodes"] == "1,333"
    assert rows["gppo"]["steps in all by then"] == "200,000"
    found = []
    with open(study / "curves.csv", newline="") as file:
        points = [row for row in csv.DictReader(file) if row["method"] == "ppo"]
    for seed in {point["seed"] for point in points}:
        own = [p for p in points if p["seed"] == seed]
        before, after = (
            next(p for p in order if sign * int(p["agent_episodes"]) >= sign * 1333)
            for order, sign in ((own, 1), (own[::-1], -1))
        )
        x = [int(p["agent_episodes"]) for p in (after, before)]
        y = [float(p["success_rate"]) for p in (after, before)]
        part = (1333 - x[0]) / (x[1] - x[0]) if x[1] > x[0] else 0.0
        found.append(y[0] + part * (y[1] - y[0]))
    found = sorted([*found, 0.0])  # and the one that failed
    assert len(found) == 8
    middle = f"{np.mean(found[2:6]):.3f}"
    assert rows["ppo"]["success there"].startswith(f"{middle}\N{NO-BREAK SPACE}[")


def test_a_row_that_was_changed_by_hand_is_refused(tmp_path):
    folder = write_study(tmp_path, seeds=range(2))
    path = folder / "runs.csv"
    text = path.read_text()
    path.write_text(text.replace(",done,0.", ",done,0.9", 1))
    with pytest.raises(ValueError, match=r"runs\.csv, line 2"):
        read_study(folder)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"seed": 99}, "the protocol does not name them"),
        ({"seed": 1, "protocol": "0" * 12}, "they are of another protocol"),
    ],
)
def test_runs_of_something_else_are_left_out_and_counted(tmp_path, change, why):
    folder = write_study(tmp_path, seeds=range(2), leave_out=[("gppo", 1)])
    results = StudyResults(folder)
    first = next(row for row in results.runs() if row["method"] == "gppo")
    results.add(first | change, [])
    evidence = read_study(folder)
    assert [run.seed for run in evidence.arm("near", "gppo").runs] == [0]
    assert f"Left out, for {why}, runs: 1." in evidence.remarks


def test_power_is_at_the_level_of_holms_first_step(study):
    evidence = read_study(study)
    section = hypotheses_section(evidence)
    rows = section.blocks[-1].rows
    shown = dict(zip(("water", "indoor"), rows, strict=True))
    assert float(shown["water"][2]) > float(shown["indoor"][2]) > 0.0
