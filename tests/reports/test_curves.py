"""Bands of curves: where they begin and end, and what a crash does to them."""

from __future__ import annotations

import numpy as np
import pytest

from gdrl_torchrl.reports.curves import band_of
from gdrl_torchrl.reports.evidence import Run


def run(x, y, *, failed=False):
    curve = {} if failed else {"total_steps": np.array(x), "success_rate": np.array(y)}
    return Run(0, "", failed, 0.0, {}, curve)


def test_a_band_is_as_long_as_all_runs_are():
    band = band_of(
        [run([10.0, 40.0], [0.0, 0.6]), run([20.0, 60.0], [0.2, 1.0])], "total_steps"
    )
    assert (band.x[0], band.x[-1]) == (20.0, 40.0)
    # Straight lines: 0.2 and 0.2 at 20, 0.6 and 0.6 at 40.
    assert band.middle[[0, -1]] == pytest.approx([0.2, 0.6])
    assert np.all(band.low <= band.middle)
    assert np.all(band.middle <= band.high)


def test_a_crash_counts_as_zero_at_every_point():
    runs = [run([0.0, 1.0], [0.9, 0.9])] * 2 + [run([], [], failed=True)]
    assert band_of(runs, "total_steps").middle == pytest.approx(0.6)


def test_one_run_has_a_line_and_no_band():
    band = band_of([run([0.0, 1.0], [0.4, 0.8])], "total_steps")
    assert band.middle[-1] == pytest.approx(0.8)
    assert np.isnan(band.low).all()


@pytest.mark.parametrize(
    "runs",
    [
        [],
        [run([], [], failed=True)],
        [run([0.0, 1.0], [0.1, 0.2]), run([], [])],
        [run([0.0, 1.0], [0.1, 0.2]), run([2.0, 3.0], [0.1, 0.2])],
    ],
)
def test_runs_that_share_no_cost_have_no_band(runs):
    assert band_of(runs, "total_steps") is None
