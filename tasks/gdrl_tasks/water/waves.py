"""A directional sea of long-crested components: its spectrum, and how it is drawn.

Every component has its own direction, drawn from a spreading function, so that no two
components share a frequency and the surface is the same statistically everywhere
(single summation; Jefferys 1987, Applied Ocean Research 9).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import numpy as np
from array_api_compat import array_namespace

GRAVITY_M_S2 = 9.81
_PEAK_ENHANCEMENT = 3.3
_SPECTRUM_GRID = 40_000
"""So fine that no two of 1,000 components fall into one step."""
_HIGHEST_RATIO = 12.0
STEEPEST = 1.0 / 15.0
"""Largest significant height over the wavelength of the peak. Severe seas have 1/20 to 1/16
(API RP 2MET, definition of wave steepness). Chosen a little above that, and safely below
breaking: a regular wave breaks at 1/7 (Michell 1893)."""
LEAST_RESOLVED = 0.75
"""Least share of a sea's energy in waves that the hull points resolve."""
SHORTEST_PERIOD_S = 0.62
"""Shortest peak period of a sea with that share."""
LONGEST_PERIOD_S = 30.0
"""Longest peak period: longer waves are not made by wind (Munk 1950)."""
SEA_FIELDS = ("amplitude", "wavenumber_x", "wavenumber_y", "omega", "phase", "decay")


@dataclasses.dataclass(frozen=True)
class SeaPreset:
    """Range of winds and fetches that a sea's episodes are drawn from."""

    wind_m_s: tuple[float, float]
    fetch_m: tuple[float, float]


SEAS: dict[str, SeaPreset | None] = {
    "calm": None,
    "lake": SeaPreset(wind_m_s=(3.0, 6.0), fetch_m=(500.0, 2000.0)),
    "rough": SeaPreset(wind_m_s=(6.0, 9.0), fetch_m=(1000.0, 3000.0)),
}


def fetch_limited_sea(wind_m_s: float, fetch_m: float) -> tuple[float, float]:
    """Significant height (m) and peak period (s) of a fetch-limited lake sea.

    g Hs/U^2 = 0.0016 (g F/U^2)^(1/2), g Tp/U = 0.286 (g F/U^2)^(1/3) (Coastal
    Engineering Manual's deep-water form).

    Examples:
        >>> height, period = fetch_limited_sea(5.0, 500.0)
        >>> round(height, 3), round(period, 2)
        (0.057, 0.85)
    """
    fetch = GRAVITY_M_S2 * fetch_m / wind_m_s**2
    height = 0.0016 * math.sqrt(fetch) * wind_m_s**2 / GRAVITY_M_S2
    return height, 0.286 * fetch ** (1.0 / 3.0) * wind_m_s / GRAVITY_M_S2


def sea_range(name: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Least and most significant height (m) and peak period (s) of a sea's episodes.

    A calm sea has no height; its period is 1 s, which then has no effect.

    Examples:
        >>> (low, high), (short, long) = sea_range("lake")
        >>> round(low, 3), round(high, 3), round(short, 2), round(long, 2)
        (0.034, 0.137, 0.71, 1.43)
    """
    preset = SEAS[name]
    if preset is None:
        return (0.0, 0.0), (1.0, 1.0)
    low, high = (
        fetch_limited_sea(wind, fetch)
        for wind, fetch in zip(preset.wind_m_s, preset.fetch_m, strict=True)
    )
    return (low[0], high[0]), (low[1], high[1])


def wavelength(period_s: float) -> float:
    """Length of a wave in deep water, m, by its period, s: g T^2 / 2 pi.

    Examples:
        >>> round(wavelength(1.0), 2)
        1.56
    """
    return GRAVITY_M_S2 * period_s**2 / (2.0 * math.pi)


def jonswap(omega: Any, height_m: float, period_s: float) -> Any:
    """JONSWAP variance density S(omega), m^2 s/rad, peak enhancement 3.3.

    Hasselmann et al. 1973, in the form S = 5/16 Hs^2 wp^4 w^-5 exp(-5/4 (wp/w)^4)
    gamma^b (1 - 0.287 ln gamma).

    Args:
        omega: Angular frequencies, rad/s, any shape, > 0.
        height_m: Significant wave height Hs.
        period_s: Peak period Tp.

    Examples:
        >>> import numpy as np
        >>> w = np.linspace(1.0, 80.0, 40_000)
        >>> variance = np.trapezoid(jonswap(w, 0.1, 1.0), w)
        >>> round(float(4 * np.sqrt(variance)), 2)
        0.1
    """
    xp = array_namespace(omega)
    peak = 2.0 * math.pi / period_s
    width = xp.where(omega <= peak, xp.full_like(omega, 0.07), xp.full_like(omega, 0.09))
    exponent = xp.exp(-((omega - peak) ** 2) / (2.0 * width**2 * peak**2))
    scale = 1.0 - 0.287 * math.log(_PEAK_ENHANCEMENT)
    shape = omega**-5.0 * xp.exp(-1.25 * (peak / omega) ** 4)
    return 0.3125 * height_m**2 * peak**4 * scale * shape * _PEAK_ENHANCEMENT**exponent


@functools.cache
def _cumulative_moments() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Moments of the unit spectrum up to a frequency, and the scaling that a cut-off needs.

    Returns:
        Frequency ratios w/wp; the running moments m0 and m-1; and the ratio to which the
        highest frequency rises if all frequencies are scaled so that m-1/m0 is that of
        the whole spectrum.
    """
    ratio = np.linspace(0.3, _HIGHEST_RATIO, _SPECTRUM_GRID)
    density = jonswap(ratio, 1.0, 2.0 * math.pi)
    step = ratio[1] - ratio[0]

    def running(values: np.ndarray) -> np.ndarray:
        middle = 0.5 * (values[1:] + values[:-1]) * step
        return np.concatenate([[0.0], np.cumsum(middle)])

    zeroth, minus_first = running(density), running(density / ratio)
    whole = minus_first[-1] / zeroth[-1]
    # Below the first step there is no energy, and so no mean.
    mean = np.divide(minus_first, zeroth, out=1.0 / ratio, where=zeroth > 0.0)
    return ratio, zeroth, minus_first, ratio * mean / whole


def draw_sea(
    generator: np.random.Generator,
    *,
    height_m: float,
    period_s: float,
    direction_rad: float,
    num_components: int,
    shortest_wave_m: float,
    depth_m: float,
) -> dict[str, np.ndarray]:
    """Draw one episode's wave components.

    The spectrum up to a cut-off is split into bins of equal energy; each bin becomes one
    component at the frequency that keeps the bin's m-1. Beyond the cut-off are waves that
    the hull points cannot resolve. Their energy is spread over the components by scaling
    heights, and frequencies are scaled too, so that height and energy period of the sum
    are those of the whole spectrum. The cut-off frequency, scaled in this way, is that of
    the shortest wave, so no component is shorter, and no two are alike.

    Args:
        generator: Source of the directions and phases.
        height_m: Significant wave height Hs, >= 0; 0 is a flat sea.
        period_s: Peak period Tp, > 0.
        direction_rad: Mean direction of travel in the world frame.
        num_components: Number ``C`` of components.
        shortest_wave_m: Length of the shortest wave.
        depth_m: Depth under the instantaneous surface at which ``decay`` holds.

    Returns:
        Arrays ``[C]``: ``amplitude`` (m), ``wavenumber_x`` and ``wavenumber_y``
        (rad/m), ``omega`` (rad/s), ``phase`` (rad), ``decay`` (orbital velocity at
        ``depth_m`` relative to the surface).

    Raises:
        ValueError: If the cut-off leaves less than :data:`LEAST_RESOLVED` of the energy.
    """
    ratio, zeroth, minus_first, scaled = _cumulative_moments()
    peak = 2.0 * math.pi / period_s
    highest = math.sqrt(GRAVITY_M_S2 * 2.0 * math.pi / shortest_wave_m)
    cut = np.interp(highest / peak, scaled, ratio)
    total = np.interp(cut, ratio, zeroth)
    if total < LEAST_RESOLVED * zeroth[-1]:
        raise ValueError(
            f"period_s={period_s}: only {total / zeroth[-1]:.0%} of the energy is in waves "
            f"longer than shortest_wave_m={shortest_wave_m}, {LEAST_RESOLVED:.0%} is needed"
        )
    edges = np.interp(np.linspace(0.0, total, num_components + 1), zeroth, ratio)
    below = np.interp(edges, ratio, minus_first)
    omega = peak * (total / num_components) / np.diff(below)
    # The waves that are cut off would shorten the energy period; shorten the rest instead.
    omega *= (below[-1] / total) / (minus_first[-1] / zeroth[-1])
    # cos^2 spreading on each side of the mean direction, by the inverse distribution.
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 181)
    share = 0.5 + (angle + 0.5 * np.sin(2.0 * angle)) / math.pi
    direction = direction_rad + np.interp(generator.random(num_components), share, angle)
    wavenumber = omega**2 / GRAVITY_M_S2
    amplitude = height_m / 4.0 * math.sqrt(2.0 / num_components)
    return {
        "amplitude": np.full(num_components, amplitude),
        "wavenumber_x": wavenumber * np.cos(direction),
        "wavenumber_y": wavenumber * np.sin(direction),
        "omega": omega,
        "phase": generator.uniform(0.0, 2.0 * math.pi, num_components),
        "decay": np.exp(-wavenumber * depth_m),
    }
