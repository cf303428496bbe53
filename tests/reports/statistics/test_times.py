"""Times to a threshold, some of which nobody has seen, against products by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gdrl_torchrl.reports.statistics.times import Crossing, crossing, median_time


def times(*reached, until=()):
    return [Crossing(float(t), True) for t in reached] + [
        Crossing(float(t), False) for t in until
    ]


def test_the_median_by_hand():
    # 5/6, 4/5 of it = 0.667 at 20; one leaves at 25; 2/3 of it = 0.444 at 30.
    assert median_time(times(10, 20, 30, 40, until=(25, 50))).value == 30.0


def test_without_censoring_it_is_the_middle_run():
    assert median_time(times(50, 10, 40, 30, 20)).value == 30.0


def test_exactly_half_is_enough():
    assert median_time(times(10, 20, until=(90, 90))).value == 20.0


def test_less_than_half_is_never():
    found = median_time(times(10, until=(90, 90)))
    assert found.value == math.inf
    assert found.high == math.inf


def test_a_run_that_failed_counts_however_early_it_was():
    failed = [Crossing(math.inf, reached=False)] * 2
    assert median_time(times(10, 20, 30) + failed).value == 30.0
    # Taken out when it failed, at 5, it would have made the others look quicker.
    assert median_time(times(10, 20, 30, until=(5, 5))).value == 20.0


def test_nobody_got_there():
    found = median_time(times(until=(90, 90)))
    assert found.value == math.inf


def test_limits_are_where_the_band_passes_one_half():
    # S after k of ten: 1 - k / 10. Log-log limits by Greenwood's formula.
    def limits(k):
        left = 1.0 - k / 10.0
        spread = sum(1.0 / ((10 - i) * (9 - i)) for i in range(k))
        error = math.sqrt(spread) / abs(math.log(left))
        return [left ** math.exp(z * 1.959964 * error) for z in (1, -1)]

    low = next(k for k in range(1, 10) if limits(k)[0] <= 0.5)
    high = next(k for k in range(1, 10) if limits(k)[1] <= 0.5)
    found = median_time(times(*range(10, 110, 10)))
    assert (found.low, found.value, found.high) == (10.0 * low, 50.0, 10.0 * high)


def test_the_median_is_within_its_limits_where_all_arrive_at_once():
    found = median_time(times(20, 20, 20, 20, 20))
    assert (found.low, found.value, found.high) == (20.0, 20.0, math.inf)


def test_a_curve_crosses_at_its_first_point_above():
    x = np.array([10.0, 20.0, 30.0])
    assert crossing(x, np.array([0.1, 0.8, 0.5]), 0.8) == Crossing(20.0, True)
    assert crossing(x, np.array([0.1, 0.7, 0.5]), 0.8) == Crossing(30.0, False)


@pytest.mark.parametrize("count", [1, 2])
def test_few_runs_have_a_median(count):
    assert median_time(times(*range(10, 10 + count))).value == 10.0
