"""The arithmetic of robot and lidar as compiled loops.

:func:`gdrl_tasks.indoor.obstacles.clearance` is the definition of :func:`clearances`,
and the engine's own rays see what :func:`scan` sees: tests hold them together. The
engine's rays take five times as long, for each call places every geom of every world.
"""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def ahead_of(position: np.ndarray, yaw: np.ndarray, distance: float) -> np.ndarray:
    """Points ahead of (if negative, behind) positions ``[K, 2]``, ``[K, 2]``."""
    points = np.empty((len(yaw), 2))
    for k in range(len(yaw)):
        points[k, 0] = position[k, 0] + distance * math.cos(yaw[k])
        points[k, 1] = position[k, 1] + distance * math.sin(yaw[k])
    return points


@numba.njit(cache=True, nogil=True, error_model="numpy")
def scan(
    origins: np.ndarray,
    yaw: np.ndarray,
    angles: np.ndarray,
    layouts: np.ndarray,
    places: np.ndarray,
    is_box: np.ndarray,
    half_size: np.ndarray,
    limits: tuple[float, float],
) -> np.ndarray:
    """Ranges of the beams at ``angles`` ``[B]`` from ``origins`` ``[K, 2]``, ``[K, B]``.

    ``layouts`` ``[K]`` are rows of ``places`` ``[M, N, 4]``; ``limits`` are the nearest
    and the farthest range that is reported, the latter for a beam that hits nothing.
    """
    nearest, farthest = limits
    ranges = np.empty((len(origins), len(angles)))
    for k in range(len(origins)):
        for b in range(len(angles)):
            cosine, sine = math.cos(yaw[k] + angles[b]), math.sin(yaw[k] + angles[b])
            hit = farthest
            for n in range(len(is_box)):
                place = places[layouts[k], n]
                x, y = origins[k, 0] - place[0], origins[k, 1] - place[1]
                if is_box[n]:
                    distance = _to_box(x, y, cosine, sine, place[2], place[3], half_size[n])
                else:
                    distance = _to_circle(x, y, cosine, sine, half_size[n, 0])
                hit = min(hit, distance)
            ranges[k, b] = max(hit, nearest)
    return ranges


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _to_circle(x: float, y: float, cosine: float, sine: float, radius: float) -> float:
    """Way from (x, y) to a circle around 0; infinite if missed, 0 from inside."""
    outside = x * x + y * y - radius * radius
    if outside <= 0.0:
        return 0.0
    towards = -(x * cosine + y * sine)
    squared = towards * towards - outside
    if towards <= 0.0 or squared < 0.0:
        return np.inf
    return towards - math.sqrt(squared)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _to_box(
    x: float,
    y: float,
    cosine: float,
    sine: float,
    turn_cosine: float,
    turn_sine: float,
    half: np.ndarray,
) -> float:
    """Way from (x, y) to a turned box around 0; infinite if missed, 0 from inside."""
    begin, end = 0.0, np.inf
    for axis in range(2):
        # Position and direction along one of the box's own axes.
        if axis == 0:
            start = turn_cosine * x + turn_sine * y
            slope = turn_cosine * cosine + turn_sine * sine
        else:
            start = turn_cosine * y - turn_sine * x
            slope = turn_cosine * sine - turn_sine * cosine
        if slope == 0.0:
            if abs(start) > half[axis]:
                return np.inf
            continue
        one, other = (-half[axis] - start) / slope, (half[axis] - start) / slope
        begin, end = max(begin, min(one, other)), min(end, max(one, other))
    return begin if begin <= end else np.inf


@numba.njit(cache=True, nogil=True, error_model="numpy")
def goal_in_sight(
    blocked: np.ndarray,
    speed: np.ndarray,
    row: int,
    column: int,
    rows_away: float,
    columns_away: float,
) -> bool:
    """Whether the straight way from a cell to a goal is free and at full speed.

    Then it is the shortest, and the sweeps need not find it: their differences are of
    first order and make it up to a tenth too long.
    """
    rows, columns = blocked.shape
    last_r, last_c = row, column
    count = int(2.0 * math.hypot(rows_away, columns_away)) + 1
    for i in range(count):
        r = int(row + i / count * rows_away + 0.5)
        c = int(column + i / count * columns_away + 0.5)
        if not (0 <= r < rows and 0 <= c < columns):
            return False
        if blocked[r, c] or speed[r, c] < 1.0:
            return False
        # Between two cells that share a corner there may be no room.
        if blocked[last_r, c] and blocked[r, last_c]:
            return False
        last_r, last_c = r, c
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fast_sweep(
    blocked: np.ndarray,
    speed: np.ndarray,
    goal_dx: np.ndarray,
    goal_dy: np.ndarray,
    cell: float,
    most_rounds: int,
) -> np.ndarray:
    """Arrival times from a goal on a grid of free cells, ``[R, C]``.

    See :meth:`gdrl_tasks.indoor.free_space.FreeSpace.distances_to`; ``goal_dx`` ``[C]``
    and ``goal_dy`` ``[R]`` are distances of columns and rows to the goal.
    """
    rows, columns = blocked.shape
    # With a border that nothing ever comes from.
    arrival = np.full((rows + 2, columns + 2), np.inf)
    _arrive_straight(blocked, speed, goal_dx, goal_dy, cell, arrival)
    for sweep in range(4 * most_rounds):
        changed = False
        for i in range(rows):
            r = i if sweep % 4 < 2 else rows - 1 - i
            for j in range(columns):
                c = j if sweep % 2 == 0 else columns - 1 - j
                if not blocked[r, c]:
                    new = _arrival_from_neighbours(arrival, r, c, cell / speed[r, c])
                    if new < arrival[r + 1, c + 1] - 1e-9:
                        arrival[r + 1, c + 1] = new
                        changed = True
        # Every cell was held against all its neighbours: no sweep will change it.
        if not changed:
            break
    return arrival[1:-1, 1:-1].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _arrive_straight(
    blocked: np.ndarray,
    speed: np.ndarray,
    goal_dx: np.ndarray,
    goal_dy: np.ndarray,
    cell: float,
    arrival: np.ndarray,
) -> None:
    """Write the times of cells from which the way to the goal is straight."""
    for r in range(len(goal_dy)):
        for c in range(len(goal_dx)):
            if blocked[r, c]:
                continue
            exact = math.hypot(goal_dx[c], goal_dy[r])
            if exact <= 1.5 * cell:
                arrival[r + 1, c + 1] = exact / speed[r, c]
            elif goal_in_sight(blocked, speed, r, c, goal_dy[r] / cell, goal_dx[c] / cell):
                arrival[r + 1, c + 1] = exact


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _arrival_from_neighbours(arrival: np.ndarray, r: int, c: int, step: float) -> float:
    """Time of a cell from the earlier ones at its sides, a step apart."""
    a = min(arrival[r, c + 1], arrival[r + 2, c + 1])
    b = min(arrival[r + 1, c], arrival[r + 1, c + 2])
    low, high = min(a, b), max(a, b)
    # Both are infinite where no way has led yet, and then their difference is no number.
    if not high - low < step:
        return low + step
    gap = high - low
    return 0.5 * (low + high + math.sqrt(2.0 * step * step - gap * gap))
