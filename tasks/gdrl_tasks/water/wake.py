"""The foam that a vessel leaves behind, which is only drawn."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

_SEEN_S = 9.0
"""Foam older than this has vanished."""
_LONGEST_GAP_S, _FASTEST_M_S = 1.5, 6.0
_STERN_X_M = -0.6
_STREAM_M = 0.378
"""Distance from the middle of the wake to the stream of each propeller."""
_SPACING_M = 0.12
_FULL_SPEED_M_S = 1.3
_FADE_S = 3.2
_NOISE_SIZE, _NOISE_CELL_M = 256, 0.05


@dataclasses.dataclass
class Track:
    """Recent places of a vessel: rows of time, x, y (metres) and heading (radians)."""

    places: list[tuple[float, float, float, float]] = dataclasses.field(
        default_factory=list
    )

    def note(self, time_s: float, x: float, y: float, heading: float) -> None:
        """Add a place; if it cannot be reached from the last one, a new track begins."""
        if self.places:
            before, last_x, last_y, last_heading = self.places[-1]
            gap = time_s - before
            if gap == 0.0 and (last_x, last_y, last_heading) == (x, y, heading):
                return
            way = math.hypot(x - last_x, y - last_y)
            if not 0.0 < gap <= _LONGEST_GAP_S or way > _FASTEST_M_S * gap:
                self.places.clear()
        self.places.append((time_s, x, y, heading))
        while self.places[0][0] < time_s - _SEEN_S:
            self.places.pop(0)


def foam(
    track: Track, x: np.ndarray, y: np.ndarray
) -> tuple[slice, slice, np.ndarray] | None:
    """Foam over the part of a grid that the wake may cover.

    There are two streams of the propellers, which widen and fade, and two arms that
    open from them. The bubbles do not move on the water.

    Args:
        track: Where the vessel was.
        x: World x of the grid's columns, metres, ascending ``[N]``.
        y: World y of its rows, metres, ascending ``[M]``.

    Returns:
        Rows and columns of that part, and how much of it is white, in [0, 1]; None if
        there is no wake.
    """
    path = _stern_path(track)
    if path is None:
        return None
    at, along, age, speed, behind = path
    margin = 1.0 + 0.34 * behind
    low, high = (at - margin[:, None]).min(axis=0), (at + margin[:, None]).max(axis=0)
    columns = slice(*np.searchsorted(x, [low[0], high[0]]))
    rows = slice(*np.searchsorted(y, [low[1], high[1]]))
    grid_x, grid_y = x[columns].astype(np.float32), y[rows].astype(np.float32)
    away_x = grid_x[None, :, None] - at[:, 0].astype(np.float32)
    away_y = grid_y[:, None, None] - at[:, 1].astype(np.float32)
    nearest = (away_x**2 + away_y**2).argmin(axis=2)
    tangent = along[nearest]
    delta = np.stack(
        [
            grid_x[None] + 0.0 * grid_y[:, None] - at[nearest, 0],
            grid_y[:, None] + 0.0 * grid_x[None] - at[nearest, 1],
        ],
        axis=-1,
    )
    ahead = (delta * tangent).sum(axis=-1)
    aside = np.abs(delta[..., 1] * tangent[..., 0] - delta[..., 0] * tangent[..., 1])
    old, fast, far = age[nearest], speed[nearest], behind[nearest] - ahead
    strength = fast * np.exp(-old / _FADE_S)
    stream = np.exp(-(((aside - _STREAM_M) / (0.1 + 0.045 * old)) ** 2))
    between = 0.55 * np.exp(-((aside / (0.2 + 0.1 * old)) ** 2)) * (1.0 - np.exp(-old))
    arm = (aside - 0.5 - 0.3 * far) / (0.07 + 0.03 * far)
    arms = 0.55 * np.exp(-(arm**2)) * np.exp(-far / 2.2)
    cover = strength * (stream + between + arms)
    # No foam ahead of the stern, and none behind the oldest known place.
    cover *= np.clip(1.0 + (far + 0.05) / 0.1, 0.0, 1.0)
    cover *= np.clip((behind[0] - far) / 0.3, 0.0, 1.0)
    bubbles = _bubbles(grid_x, grid_y)
    return rows, columns, np.clip(cover * (0.25 + 1.5 * bubbles), 0.0, 0.95)


def _stern_path(track: Track) -> tuple[np.ndarray, ...] | None:
    """Equally spaced places of the stern, oldest first; None if it has not moved.

    Returns:
        Place (m) ``[K, 2]``, direction of travel ``[K, 2]``, age (s), speed in parts
        of full speed, and distance travelled since (m), ``[K]`` each.
    """
    if len(track.places) < 2:
        return None
    time_s, x, y, heading = np.array(track.places).T
    at = np.stack(
        [x + _STERN_X_M * np.cos(heading), y + _STERN_X_M * np.sin(heading)], axis=-1
    )
    step = np.hypot(*np.diff(at, axis=0).T)
    length = np.concatenate([[0.0], np.cumsum(step)])
    if length[-1] < _SPACING_M:
        return None
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    made = (np.diff(at, axis=0) * ahead[1:]).sum(axis=-1) / np.diff(time_s)
    made = np.concatenate([made[:1], made])
    # Only a vessel that goes ahead has its wake behind its stern.
    speed = np.clip(made / _FULL_SPEED_M_S, 0.0, 1.0)
    wanted = length[-1] - np.arange(0.0, length[-1], _SPACING_M)[::-1]
    known = np.concatenate([[True], step > 1e-6])
    places = [
        np.interp(wanted, length[known], values[known])
        for values in (at[:, 0], at[:, 1], time_s[-1] - time_s, speed)
    ]
    at = np.stack(places[:2], axis=-1)
    if len(at) < 2:
        return None
    along = np.gradient(at, axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    return at, along, places[2], places[3], length[-1] - wanted


def _bubbles(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A fixed pattern of the water's surface, [0, 1], ``[M, N]``."""
    column = np.floor(x / _NOISE_CELL_M).astype(np.int64) % _NOISE_SIZE
    row = np.floor(y / _NOISE_CELL_M).astype(np.int64) % _NOISE_SIZE
    return _PATTERN[np.ix_(row, column)]


def _pattern() -> np.ndarray:
    generator = np.random.default_rng(0)
    total = np.zeros((_NOISE_SIZE, _NOISE_SIZE))
    for blur in (1, 3, 6):
        noise = generator.normal(size=total.shape)
        frequency = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(_NOISE_SIZE)]))
        smooth = np.fft.ifft2(np.fft.fft2(noise) * np.exp(-((4.0 * blur * frequency) ** 2)))
        total += smooth.real / smooth.real.std()
    total = (total - total.mean()) / total.std()
    return np.clip(0.5 + 0.3 * total, 0.0, 1.0).astype(np.float32)


_PATTERN = _pattern()
