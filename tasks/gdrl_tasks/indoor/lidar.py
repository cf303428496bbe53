"""A planar lidar like the LDS-01: directions, limits and errors of its beams."""

from __future__ import annotations

import math

import numpy as np

NEAREST_M, FARTHEST_M = 0.12, 3.5
SCAN_INTERVAL_S = 0.2
"""Time of one turn at 300 rpm."""

# Precision in the data sheet: 10 mm to 0.5 m, 3.5 % of the range beyond.
_NEAR_M, _NEAR_STD_M, _FAR_STD = 0.499, 0.010, 0.035


def beam_angles(num_beams: int, field_of_view_deg: float) -> np.ndarray:
    """Directions of the beams from right to left, radians from straight ahead, ``[B]``.

    A full circle has no two beams in the same direction.

    Examples:
        >>> np.degrees(beam_angles(3, 180.0)).tolist()
        [-90.0, 0.0, 90.0]
        >>> np.degrees(beam_angles(4, 360.0)).tolist()
        [-180.0, -90.0, 0.0, 90.0]
    """
    half = 0.5 * math.radians(field_of_view_deg)
    if num_beams == 1:
        return np.zeros(1)
    closed = field_of_view_deg < 360.0
    return np.linspace(-half, half, num_beams, endpoint=closed)


def range_noise(
    ranges_m: np.ndarray, episode_seed: np.ndarray, scan_number: np.ndarray
) -> np.ndarray:
    """Errors of the LDS-01's precision, metres, ``[K, B]``.

    They are a function of episode, scan and beam. So a repeated or resumed episode has the
    same scans, and there is no state to keep.

    Args:
        ranges_m: True ranges, ``[K, B]``.
        episode_seed: Seeds of the episodes, int64 ``[K]``.
        scan_number: Number of the scan in its episode, int64 ``[K]``.
    """
    std = np.where(ranges_m <= _NEAR_M, _NEAR_STD_M, _FAR_STD * ranges_m)
    beams = np.arange(2 * ranges_m.shape[1], dtype=np.uint64)
    key = _scramble(episode_seed.astype(np.uint64))
    key = _scramble(key + scan_number.astype(np.uint64))
    bits = _scramble(key[:, None] + beams)
    uniform = ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    first, second = np.split(uniform, 2, axis=1)
    # Box and Muller's transform of two uniform numbers to a normal one.
    return std * np.sqrt(-2.0 * np.log(first)) * np.cos(2.0 * math.pi * second)


def _scramble(value: np.ndarray) -> np.ndarray:
    """Finaliser of SplitMix64 (Steele et al. 2014), on uint64 arrays."""
    with np.errstate(over="ignore"):
        value = value + np.uint64(0x9E3779B97F4A7C15)
        value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))
