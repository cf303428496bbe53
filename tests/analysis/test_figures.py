"""Figures show the run's numbers, and are files that can be opened."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gdrl_torchrl.analysis.figures import draw_learning_curve
from gdrl_torchrl.analysis.learning_curve import (
    evaluation_rows,
    make_learning_curve,
    wilson_interval,
)
from gdrl_torchrl.analysis.run_files import read_evaluation, read_metrics


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
    minutes = [0.2, 0.4, 0.5, 0.7, 0.8]
    np.testing.assert_allclose(curves[2].get_xdata(), minutes)


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
    np.testing.assert_allclose(markers, [[[1400, 0.95]], [[600, 0.95]], [[0.8, 0.95]]])
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
