"""Figures show the run's numbers, and are files that can be opened."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gdrl_torchrl.files.evaluation import read_evaluation
from gdrl_torchrl.files.metrics import read_metrics
from gdrl_torchrl.pictures.figures import draw_learning_curve
from gdrl_torchrl.pictures.learning_curve import (
    evaluation_rows,
    make_learning_curve,
    wilson_interval,
)


def _is_picture(path: Path) -> bool:
    with Image.open(path) as image:
        image.load()
        pixels = np.asarray(image.convert("RGB"))
    return image.format == "PNG" and min(pixels.shape[:2]) > 500 and pixels.std() > 5


def test_learning_curve_is_written(run_dir: Path) -> None:
    path = draw_learning_curve(run_dir)

    assert path == run_dir / "figures" / "learning_curve.png"
    assert _is_picture(path)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_success_is_drawn_over_every_cost(run_dir: Path) -> None:
    figure = make_learning_curve(read_metrics(run_dir), read_evaluation(run_dir))

    curves = [axes.lines[0] for axes in figure.axes[:3]]
    expected = ([200, 700, 800, 1300, 1400], [200, 300, 400, 500, 600])
    for curve, x in zip(curves, expected, strict=False):
        np.testing.assert_allclose(curve.get_xdata(), x)
        np.testing.assert_allclose(curve.get_ydata(), [0.0, 0.25, 0.5, 0.5, 1.0])
    seconds = [12.0, 24.0, 30.0, 42.0, 48.0]
    np.testing.assert_allclose(curves[2].get_xdata(), seconds)


def test_evaluations_are_marked_by_whether_the_agent_was_replaced(run_dir: Path) -> None:
    metrics = read_metrics(run_dir)
    figure = make_learning_curve(metrics)

    steps, stayed, replaced = figure.axes[3].lines
    assert np.flatnonzero(evaluation_rows(metrics)).tolist() == [2, 4]
    np.testing.assert_allclose(steps.get_xydata(), [[700, 0.75], [1300, 0.4], [1400, 0.4]])
    np.testing.assert_allclose(stayed.get_xydata(), [[1300, 0.4]])
    np.testing.assert_allclose(replaced.get_xydata(), [[700, 0.75]])


def test_held_out_success_stands_at_the_end(run_dir: Path) -> None:
    figure = make_learning_curve(read_metrics(run_dir), read_evaluation(run_dir))

    markers = [axes.containers[0].lines[0].get_xydata() for axes in figure.axes[:3]]
    np.testing.assert_allclose(markers, [[[1400, 0.95]], [[600, 0.95]], [[48.0, 0.95]]])
    legend = figure.legends[0].get_texts()
    assert legend[-1].get_text() == "held out: 95.0 % of 200 episodes"


def test_learning_curve_without_evolution_has_one_row(run_dir: Path) -> None:
    metrics = read_metrics(run_dir)
    for name in ("switched", "mut_p", "winner"):
        del metrics[name]

    figure = make_learning_curve(metrics)

    assert len(figure.axes) == 3


def test_run_that_ended_no_episode_can_be_drawn(tmp_path: Path) -> None:
    header = "agent_steps,total_steps,wall_s,success_rate,switched,mut_p"
    (tmp_path / "metrics.csv").write_text(header + "\n10,10,1.0,,,\n")
    assert _is_picture(draw_learning_curve(tmp_path))

    (tmp_path / "metrics.csv").write_text(header + "\n")
    assert _is_picture(draw_learning_curve(tmp_path))


def test_curve_of_a_perfect_agent_is_drawn(run_dir: Path) -> None:
    evaluation = read_evaluation(run_dir) | {"success_rate": 1.0}
    (run_dir / "evaluation.json").write_text(json.dumps(evaluation))

    assert _is_picture(draw_learning_curve(run_dir))


def test_wilson_interval_agrees_with_a_published_value() -> None:
    # Newcombe 1998 (Statistics in Medicine 17), Table I: 81 of 263.
    assert wilson_interval(81 / 263, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)


@pytest.mark.parametrize(
    ("longest_s", "shown"),
    [(0.2, "0.2 s"), (48.0, "48 s"), (120.0, "2 min"), (5e4, "14 h")],
)
def test_time_has_a_unit_in_which_it_can_be_read(
    run_dir: Path, longest_s: float, shown: str
) -> None:
    metrics = read_metrics(run_dir)
    metrics["wall_s"] *= longest_s / 48.0
    top, below = make_learning_curve(metrics).axes[2::3]
    value, unit = shown.split()
    assert below.get_xlabel() == f"wall time ({unit})"
    assert top.lines[0].get_xdata()[-1] == pytest.approx(float(value), rel=0.02)


def test_a_population_without_an_agent_has_fitness_and_no_panel_of_the_agent(
    run_dir: Path,
) -> None:
    metrics = read_metrics(run_dir)
    rows = evaluation_rows(metrics)
    metrics["agent_steps"][:] = 0.0
    metrics["mut_p"][:] = np.nan
    metrics["fitness_best"] = np.where(rows, 3.0, np.nan)
    metrics["fitness_mean"] = np.where(rows, 1.5, np.nan)
    figure = make_learning_curve(metrics)
    assert [axes.get_xlabel() for axes in figure.axes] == [
        *("", ""),
        *("environment steps of the population", "wall time (s)"),
    ]
    best, mean, kept, switched = figure.axes[2].lines
    np.testing.assert_allclose(best.get_xydata(), [[700, 3.0], [1300, 3.0]])
    np.testing.assert_allclose(mean.get_ydata(), [1.5, 1.5])
    np.testing.assert_allclose(kept.get_xydata(), [[1300, 3.0]])
    np.testing.assert_allclose(switched.get_xydata(), [[700, 3.0]])
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert said == [
        "the elite, when it was chosen",
        "generation with a new elite (1)",
        "the elite stayed (1)",
    ]


def test_a_population_beside_an_agent_says_whether_that_is_among_the_elites(
    run_dir: Path,
) -> None:
    metrics = read_metrics(run_dir)
    metrics["mut_p"][:] = np.nan
    metrics["fitness_best"] = np.where(evaluation_rows(metrics), 3.0, np.nan)
    figure = make_learning_curve(metrics)
    assert len(figure.axes) == 6
    said = [text.get_text() for text in figure.legends[0].get_texts()]
    assert said[1:] == [
        "evaluation, the agent's copy among the elites (1)",
        "not among them (1)",
    ]


def test_nothing_is_counted_of_which_nothing_is_drawn(run_dir: Path) -> None:
    metrics = read_metrics(run_dir)
    metrics["mut_p"][:] = np.nan
    figure = make_learning_curve(metrics)
    assert len(figure.axes) == 3
    assert len(figure.legends[0].get_texts()) == 1


def test_few_steps_are_not_told_in_thousandths(run_dir: Path) -> None:
    metrics = read_metrics(run_dir)
    for name in ("total_steps", "agent_steps"):
        metrics[name] = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    metrics["switched"][:] = np.nan
    figure = make_learning_curve(metrics)
    figure.draw_without_rendering()
    for axes in figure.axes[:2]:
        labels = [label.get_text() for label in axes.get_xticklabels()]
        assert labels
        assert not any("m" in label for label in labels), labels
