"""The committed table of presets: all of them, the criteria, and what is measured again."""

from __future__ import annotations

import statistics
from importlib import resources

import pytest
import yaml
from scipy.stats import binomtest

from benchmarks.presets.known import PRESETS
from benchmarks.presets.measure import scripted, untrained
from benchmarks.presets.table import SUMMARY, certified, read_table, summary
from gdrl_tasks import task_names
from gdrl_torchrl.cli.shared.names import names_in
from tests.marks import full_but

LIMITS = {
    "scripted": (0.9, 1.0),
    "untrained_greedy": (0.0, 0.02),
    "untrained_sampled": (0.0, 0.02),
    "bare_agent_mean": (0.1, 0.7),
    "bare_agent_sd": (0.1, 1.0),
}
OF_AGENTS = ("algorithm.", "network.", "+tuned=")
ANY_PRESET = {"pilot", "paper_indoor", "paper_water", "generalisation", "ablation"}
"""Studies that ask what runs cost, repeat those of the papers on the papers' tasks, ask
what an effect on these is owed to, or take policies that succeed in their own worlds to
others."""
TASKS = sorted(set(names_in("task")) - set(task_names()))
ROWS = {(row.preset, row.criterion): row for row in read_table()}
every_row = pytest.mark.parametrize(
    "row", ROWS.values(), ids=lambda r: f"{r.preset}-{r.criterion}"
)


def test_every_preset_and_regime_is_known_and_nothing_else_is_in_the_table():
    assert {name for name in PRESETS if name in TASKS} == set(TASKS)
    choices = {choice for preset in PRESETS.values() for choice in preset.choices}
    assert {f"+regime={name}" for name in names_in("regime")} <= choices
    assert {name for name, _ in ROWS} <= set(PRESETS)


@pytest.mark.parametrize("name", PRESETS)
def test_the_controller_of_every_preset_is_in_the_table(name):
    assert (name, "scripted") in ROWS


@every_row
def test_a_row_says_what_its_success_rates_say(row):
    rates = [float(rate) for rate in row.success.split()]
    assert len(rates) == len(row.seeds.split())
    figure = statistics.stdev(rates) if "sd" in row.criterion else statistics.mean(rates)
    assert float(row.figure) == pytest.approx(figure, abs=2e-4)
    assert float(row.low) - 2e-4 <= figure <= float(row.high) + 2e-4
    least, most = LIMITS[row.criterion]
    assert (float(row.least), float(row.most)) == (least, most)
    assert row.verdict == ("pass" if least <= float(row.figure) <= most else "fail")


def test_the_summary_has_a_line_for_every_preset_and_is_that_of_the_table():
    text = SUMMARY.read_text()
    assert text == summary(list(ROWS.values()))
    columns, _, *lines = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()
    ]
    assert [line[0] for line in lines] == [
        f"`{name}`" for name in sorted({name for name, _ in ROWS})
    ]
    for line in lines:
        of = dict(zip(columns, line, strict=True))
        for criterion in LIMITS:
            row = ROWS.get((of["preset"].strip("`"), criterion))
            figure = f"{float(row.figure):.3f}" if row else ""
            is_bold = row is not None and row.verdict == "fail"
            assert of[criterion] == (f"**{figure}**" if is_bold else figure)
            assert not is_bold or of["verdict"] == "failed"


@pytest.mark.parametrize("name", full_but([*TASKS][::3], TASKS))
def test_a_controller_that_is_measured_again_agrees_with_the_table(name):
    episodes = 16
    rate = scripted(PRESETS[name].overrides, episodes, num_threads=1)
    assert agrees([rate], episodes, ROWS[name, "scripted"])


@pytest.mark.parametrize(
    "row",
    [row for row in ROWS.values() if row.criterion.startswith("untrained_")],
    ids=lambda row: f"{row.preset}-{row.criterion}",
)
def test_untrained_networks_that_are_measured_again_agree_with_the_table(row):
    episodes, mode = 5, row.criterion.removeprefix("untrained_")
    overrides = PRESETS[row.preset].overrides
    rates = untrained(overrides, mode, episodes, num_threads=1)
    assert agrees(list(rates), episodes, row)


def agrees(rates, episodes, row):
    """Whether the 99 % interval of a small measurement meets that of the table."""
    count = len(rates) * episodes
    own = binomtest(round(sum(rates) * episodes), count).proportion_ci(0.99)
    return own.low <= float(row.high) and float(row.low) <= own.high


def test_a_regime_is_of_the_task_of_its_preset():
    for preset in PRESETS.values():
        task = preset.choices[0].removeprefix("task=")
        assert ROWS[preset.name, "scripted"].success == ROWS[task, "scripted"].success


def test_studies_compare_on_certified_presets_only():
    verdicts = certified(list(ROWS.values()))
    folder = resources.files("gdrl_torchrl.conf").joinpath("study")
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    for file in files:
        if file.name.removesuffix(".yaml") in ANY_PRESET:
            continue
        for overrides in yaml.safe_load(file.read_text())["tasks"].values():
            # What makes an agent may stand beside what makes its worlds.
            worlds = {o for o in overrides if not o.startswith(OF_AGENTS)}
            used = [p.name for p in PRESETS.values() if set(p.choices) == worlds]
            assert [verdicts[name] for name in used] == ["certified"], (
                file.name,
                overrides,
            )
