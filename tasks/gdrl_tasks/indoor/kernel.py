"""The arithmetic of robot and lidar as compiled loops.

:func:`gdrl_tasks.indoor.definition.clearance` is the definition of :func:`clearances`,
and the engine's own rays define :func:`scan`; tests compare them. The engine's rays take
five times as long, because each call places every geom of every world.
"""

from __future__ import annotations

import math

import numpy as np

from gdrl_tasks.compiled import compiled

_TINY = 1e-300
"""Used for a slope of 0: a beam along a side crosses it infinitely far away."""


@compiled
def clearances(
    points: np.ndarray,
    layouts: np.ndarray,
    places: np.ndarray,
    is_box: np.ndarray,
    half_size: np.ndarray,
) -> np.ndarray:
    """Distance of points ``[K, 2]`` to the nearest surface in their layouts, ``[K]``.

    ``layouts`` ``[K]`` are rows of ``places`` ``[M, N, 4]``.
    """
    nearest = np.full(len(points), np.inf)
    for k in range(len(points)):
        for n in range(len(is_box)):
            place = places[layouts[k], n]
            dx, dy = points[k, 0] - place[0], points[k, 1] - place[1]
            if is_box[n]:
                over_x = abs(place[2] * dx + place[3] * dy) - half_size[n, 0]
                over_y = abs(place[2] * dy - place[3] * dx) - half_size[n, 1]
                if over_x > 0.0 and over_y > 0.0:
                    distance = math.hypot(over_x, over_y)
                else:
                    distance = max(over_x, over_y)
            else:
                distance = math.hypot(dx, dy) - half_size[n, 0]
            nearest[k] = min(nearest[k], distance)
    return nearest


@compiled
def clearances_on_grid(
    x: np.ndarray,
    y: np.ndarray,
    places: np.ndarray,
    is_box: np.ndarray,
    half_size: np.ndarray,
) -> np.ndarray:
    """:func:`clearances` of all points of a grid in one layout, ``[R, C]``.

    ``x`` ``[C]`` and ``y`` ``[R]`` are columns and rows; ``places`` is ``[N, 4]``.
    """
    nearest = np.full((len(y), len(x)), np.inf)
    for n in range(len(is_box)):
        # A cylinder is computed as a box without extent, rounded by its radius. So there
        # are no branches, and the points of a row are computed side by side.
        half_x = half_size[n, 0] if is_box[n] else 0.0
        half_y = half_size[n, 1] if is_box[n] else 0.0
        radius = 0.0 if is_box[n] else half_size[n, 0]
        middle_x, middle_y, cosine, sine = places[n]
        for i in range(len(y)):
            dy = y[i] - middle_y
            row = nearest[i]
            for j in range(len(x)):
                dx = x[j] - middle_x
                over_x = abs(cosine * dx + sine * dy) - half_x
                over_y = abs(cosine * dy - sine * dx) - half_y
                out_x = over_x if over_x > 0.0 else 0.0
                out_y = over_y if over_y > 0.0 else 0.0
                inside = over_x if over_x > over_y else over_y
                inside = inside if inside < 0.0 else 0.0
                distance = math.sqrt(out_x * out_x + out_y * out_y) + inside - radius
                row[j] = distance if distance < row[j] else row[j]
    return nearest


@compiled
def ahead_of(position: np.ndarray, yaw: np.ndarray, distance: float) -> np.ndarray:
    """Points ahead of (if negative, behind) positions ``[K, 2]``, ``[K, 2]``."""
    points = np.empty((len(yaw), 2))
    for k in range(len(yaw)):
        points[k, 0] = position[k, 0] + distance * math.cos(yaw[k])
        points[k, 1] = position[k, 1] + distance * math.sin(yaw[k])
    return points


@compiled
def clearances_ahead(
    position: np.ndarray,
    yaw: np.ndarray,
    distance: float,
    layouts: np.ndarray,
    places: np.ndarray,
    is_box: np.ndarray,
    half_size: np.ndarray,
) -> np.ndarray:
    """:func:`clearances` of the points ahead of positions, ``[K]``."""
    points = ahead_of(position, yaw, distance)
    return clearances(points, layouts, places, is_box, half_size)


@compiled
def scan_ahead(
    position: np.ndarray,
    yaw: np.ndarray,
    distance: float,
    beams: np.ndarray,
    layouts: np.ndarray,
    places: np.ndarray,
    is_box: np.ndarray,
    half_size: np.ndarray,
    limits: tuple[float, float],
) -> np.ndarray:
    """:func:`scan` from the points ahead of positions, ``[K, B]``."""
    origins = ahead_of(position, yaw, distance)
    return scan(origins, yaw, beams, layouts, places, is_box, half_size, limits)


@compiled
def scan(
    origins: np.ndarray,
    yaw: np.ndarray,
    beams: np.ndarray,
    layouts: np.ndarray,
    places: np.ndarray,
    is_box: np.ndarray,
    half_size: np.ndarray,
    limits: tuple[float, float],
) -> np.ndarray:
    """Ranges of beams from ``origins`` ``[K, 2]``, ``[K, B]``.

    ``beams`` ``[2, B]`` are cosines and sines of their angles to the heading;
    ``layouts`` ``[K]`` are rows of ``places`` ``[M, N, 4]``; ``limits`` are the nearest
    and the farthest range that is reported, the latter for a beam that hits nothing.
    """
    nearest, farthest = limits
    ranges = np.full((len(origins), beams.shape[1]), farthest)
    for k in range(len(origins)):
        ahead, left = math.cos(yaw[k]), math.sin(yaw[k])
        for n in range(len(is_box)):
            # Everything is in the obstacle's own axes, the same for all its beams.
            x, y, cosine, sine = places[layouts[k], n]
            dx, dy = origins[k, 0] - x, origins[k, 1] - y
            start = cosine * dx + sine * dy, cosine * dy - sine * dx
            heading = cosine * ahead + sine * left, cosine * left - sine * ahead
            if is_box[n]:
                _to_box(start, heading, beams, half_size[n], ranges[k])
            else:
                _to_circle(start, heading, beams, half_size[n, 0], ranges[k])
        for b in range(beams.shape[1]):
            ranges[k, b] = max(ranges[k, b], nearest)
    return ranges


@compiled
def _to_circle(
    start: tuple[float, float],
    heading: tuple[float, float],
    beams: np.ndarray,
    radius: float,
    ranges: np.ndarray,
) -> None:
    """Shorten the ranges ``[B]`` of beams that hit a circle around 0."""
    outside = start[0] * start[0] + start[1] * start[1] - radius * radius
    ahead = start[0] * heading[0] + start[1] * heading[1]
    left = start[1] * heading[0] - start[0] * heading[1]
    for b in range(beams.shape[1]):
        towards = -(ahead * beams[0, b] + left * beams[1, b])
        squared = towards * towards - outside
        if outside <= 0.0:
            ranges[b] = 0.0
        elif towards > 0.0 and squared >= 0.0:
            ranges[b] = min(ranges[b], towards - math.sqrt(squared))


@compiled
def _to_box(
    start: tuple[float, float],
    heading: tuple[float, float],
    beams: np.ndarray,
    half: np.ndarray,
    ranges: np.ndarray,
) -> None:
    """Shorten the ranges ``[B]`` of beams that hit a box around 0; 0 from inside."""
    (x, y), (c, s) = start, heading
    # No branches, so that beams are computed side by side: each crosses the two pairs
    # of parallel sides, one pair after the other.
    for b in range(beams.shape[1]):
        slope = c * beams[0, b] - s * beams[1, b]
        over = 1.0 / (slope if slope != 0.0 else _TINY)
        middle, reach = -x * over, abs(half[0] * over)
        begin, end = middle - reach, middle + reach
        slope = s * beams[0, b] + c * beams[1, b]
        over = 1.0 / (slope if slope != 0.0 else _TINY)
        middle, reach = -y * over, abs(half[1] * over)
        begin = middle - reach if middle - reach > begin else begin
        end = middle + reach if middle + reach < end else end
        begin = begin if begin > 0.0 else 0.0
        hit = begin if begin <= end else np.inf
        ranges[b] = hit if hit < ranges[b] else ranges[b]
