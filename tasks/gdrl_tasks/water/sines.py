"""Sines and cosines of many angles at once, as a compiled loop without branches."""

from __future__ import annotations

import math

from gdrl_tasks.compiled import compiled

_TWO_OVER_PI = 2.0 / math.pi
# Half pi in three parts (Cody and Waite 1980): products of the first two with whole
# numbers below 2**20 are exact.
_HALF_PI_HIGH = 1.57079632673412561417e00
_HALF_PI_MIDDLE = 6.07710050630396597660e-11
_HALF_PI_LOW = 2.02226624879595063154e-21
_ROUND = 6755399441055744.0
"""1.5 * 2**52: adding and subtracting it rounds to a whole number."""


@compiled
def sines(angle, cosine, sine):  # pragma: no cover - compiled
    """Write cosines and sines of angles below 1e6 radians, all ``[N]``.

    The absolute error is 1e-15 or, for large angles, that of their own rounding. The
    library's functions take one number at a time; this is a loop without branches.
    Coefficients are those of the Taylor series, which is accurate enough on
    [-pi/4, pi/4].
    """
    for i in range(len(angle)):
        turns = (angle[i] * _TWO_OVER_PI + _ROUND) - _ROUND
        rest = angle[i] - turns * _HALF_PI_HIGH
        rest = (rest - turns * _HALF_PI_MIDDLE) - turns * _HALF_PI_LOW
        square = rest * rest
        odd = -1.0 / 1307674368000.0
        odd = odd * square + 1.0 / 6227020800.0
        odd = odd * square - 1.0 / 39916800.0
        odd = odd * square + 1.0 / 362880.0
        odd = odd * square - 1.0 / 5040.0
        odd = odd * square + 1.0 / 120.0
        odd = odd * square - 1.0 / 6.0
        odd = rest + rest * (square * odd)
        even = 1.0 / 20922789888000.0
        even = even * square - 1.0 / 87178291200.0
        even = even * square + 1.0 / 479001600.0
        even = even * square - 1.0 / 3628800.0
        even = even * square + 1.0 / 40320.0
        even = even * square - 1.0 / 720.0
        even = even * square + 1.0 / 24.0
        even = 1.0 - 0.5 * square + square * square * even
        # The quarter of the circle, as -2, -1, 0, 1 or 2.
        quarter = turns - 4.0 * ((0.25 * turns + _ROUND) - _ROUND)
        swapped = quarter * quarter == 1.0
        behind = quarter * quarter == 4.0
        first = odd if swapped else even
        second = even if swapped else odd
        cosine[i] = -first if (behind or quarter == 1.0) else first
        sine[i] = -second if (behind or quarter == -1.0) else second
