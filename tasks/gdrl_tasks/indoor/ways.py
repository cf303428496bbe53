"""Shortest ways on a grid of free cells, as compiled loops."""

from __future__ import annotations

import math

import numpy as np

from gdrl_tasks.compiled import compiled

_SLOPES = 256
"""Number of directions behind each of the four sides of a square."""


@compiled
def sure_looks(spare: np.ndarray, free: float, fast: float) -> np.ndarray:
    """How far :func:`goal_in_sight` may go without a look, for each cell ``[R, C]``.

    ``spare`` is the room around each cell ``[R, C]``; ``free`` is the least room of a
    free cell and ``fast`` that of a cell that is passed at full speed, all in cells. The
    result is 0 for a cell that is not free and 1 for a slow one. For others it is one more
    than the number of looks (half a cell each), the next one included, until there may be
    something in the way.
    """
    looks = np.empty(spare.shape, dtype=np.uint8)
    for r in range(spare.shape[0]):
        for c in range(spare.shape[1]):
            # Room shrinks by at most one cell per cell. A look is within 0.71 cells of its
            # own cell's middle, and within 1.12 of the middle of one whose corner it cuts.
            sure = 2.0 * (spare[r, c] - fast - 1.9)
            looks[r, c] = 1 + min(max(sure, 1.0), 250.0)
            if spare[r, c] < fast:
                looks[r, c] = 1 if spare[r, c] >= free else 0
    return looks


@compiled
def goal_in_sight(
    looks: np.ndarray,
    row: int,
    column: int,
    rows_away: float,
    columns_away: float,
    known: float = 0.0,
) -> bool:
    """Whether the straight way from a cell to a goal is free and at full speed.

    Then the straight way is the shortest, and no sweep is needed: the differences of
    sweeps are of first order and make ways up to a tenth too long. ``looks`` ``[R, C]``
    are those of :func:`sure_looks`; the last share of the way, which is ``known`` to be
    free and fast, needs no looks.
    """
    rows, columns = looks.shape
    # There are two looks per cell of the way.
    count = int(2.0 * math.sqrt(rows_away * rows_away + columns_away * columns_away)) + 1
    step_r, step_c = rows_away / count, columns_away / count
    last_r, last_c = row, column
    i, end = 0, count - int(known * count)
    while i < end:
        r = int(row + i * step_r + 0.5)
        c = int(column + i * step_c + 0.5)
        if not (0 <= r < rows and 0 <= c < columns):
            return False
        sure = looks[r, c]
        if sure < 2:
            return False
        # Between two cells that share only a corner there may be no room.
        if r != last_r and c != last_c and not looks[last_r, c] and not looks[r, last_c]:
            return False
        i += sure - 1
        last_r = int(row + (i - 1) * step_r + 0.5)
        last_c = int(column + (i - 1) * step_c + 0.5)
    return True


@compiled
def fast_sweep(
    looks: np.ndarray,
    speed: np.ndarray,
    goal_dx: np.ndarray,
    goal_dy: np.ndarray,
    cell: float,
    most_rounds: int,
    reach: float,
) -> np.ndarray:
    """Arrival times from a goal on a grid of free cells, ``[R, C]``.

    See :meth:`gdrl_tasks.indoor.free_space.FreeSpace.distances_to`; ``goal_dx`` ``[C]``
    and ``goal_dy`` ``[R]`` are distances of columns and rows to the goal; ``looks``
    ``[R, C]`` are those of :func:`sure_looks`. Cells farther from the goal than ``reach``
    are left out: times up to ``reach``, at full speed, do not depend on them.
    """
    rows, columns = looks.shape
    first_r, last_r = _rows_within(goal_dy, reach)
    first_c, last_c = _rows_within(goal_dx, reach)
    # With a border of cells that are never reached.
    arrival = np.full((rows + 2, columns + 2), np.inf)
    is_open = np.zeros(arrival.shape, dtype=np.uint8)
    _arrive_straight(looks, speed, goal_dx, goal_dy, cell, reach, arrival, is_open)
    # A cell is compared with its neighbours again only if one of them has changed.
    due = np.zeros_like(is_open)
    for r in range(first_r + 1, last_r + 2):
        for c in range(first_c + 1, last_c + 2):
            if arrival[r, c] < np.inf:
                _make_neighbours_due(due, is_open, r, c)
                due[r, c] |= is_open[r, c]
    for sweep in range(4 * most_rounds):
        changed = False
        for i in range(last_r - first_r + 1):
            r = first_r + i if sweep % 4 < 2 else last_r - i
            for j in range(last_c - first_c + 1):
                c = first_c + j if sweep % 2 == 0 else last_c - j
                if due[r + 1, c + 1]:
                    due[r + 1, c + 1] = 0
                    new = _arrival_from_neighbours(arrival, r, c, cell / speed[r, c])
                    if new < arrival[r + 1, c + 1] - 1e-9:
                        arrival[r + 1, c + 1] = new
                        _make_neighbours_due(due, is_open, r + 1, c + 1)
                        changed = True
        # Every cell was compared with all its neighbours: no sweep will change any.
        if not changed:
            break
    return arrival[1:-1, 1:-1].copy()


@compiled
def _rows_within(away: np.ndarray, reach: float) -> tuple[int, int]:
    """First and last of the rows whose distances ``[R]``, in order, are within reach."""
    first, last = 0, len(away) - 1
    while first < last and abs(away[first]) > reach:
        first += 1
    while last > first and abs(away[last]) > reach:
        last -= 1
    return first, last


@compiled
def _make_neighbours_due(due: np.ndarray, is_open: np.ndarray, r: int, c: int) -> None:
    due[r - 1, c] |= is_open[r - 1, c]
    due[r + 1, c] |= is_open[r + 1, c]
    due[r, c - 1] |= is_open[r, c - 1]
    due[r, c + 1] |= is_open[r, c + 1]


@compiled
def _arrive_straight(
    looks: np.ndarray,
    speed: np.ndarray,
    goal_dx: np.ndarray,
    goal_dy: np.ndarray,
    cell: float,
    reach: float,
    arrival: np.ndarray,
    is_open: np.ndarray,
) -> None:
    """Write the times of cells from which the way to the goal is straight.

    ``is_open`` becomes 1 for the other free cells. A straight way at full speed is the
    shortest. The differences of sweeps never give a shorter one, as distance is convex.
    """
    rows_away, columns_away = goal_dy / cell, goal_dx / cell
    hidden, clear = horizons(looks, rows_away, columns_away, reach / cell)
    first_r, last_r = _rows_within(goal_dy, reach)
    first_c, last_c = _rows_within(goal_dx, reach)
    for r in range(first_r, last_r + 1):
        for c in range(first_c, last_c + 1):
            if not looks[r, c]:
                continue
            exact = math.hypot(goal_dx[c], goal_dy[r])
            if exact > reach:
                continue
            if exact <= 1.5 * cell:
                arrival[r + 1, c + 1] = exact / speed[r, c]
                is_open[r + 1, c + 1] = speed[r, c] < 1.0
                continue
            face, slope, along = _direction(-rows_away[r], -columns_away[c])
            in_sight = along <= clear[face, slope]
            if not in_sight and along < hidden[face, slope]:
                known = clear[face, slope] / along
                in_sight = goal_in_sight(looks, r, c, rows_away[r], columns_away[c], known)
            if in_sight:
                arrival[r + 1, c + 1] = exact
            else:
                is_open[r + 1, c + 1] = 1


@compiled
def _direction(y: float, x: float) -> tuple[int, int, float]:
    """The side of a square around the goal that a cell is behind, its slope, how far."""
    if abs(x) >= abs(y):
        face, along, across = (0, x, y) if x >= 0.0 else (1, -x, y)
    else:
        face, along, across = (2, y, x) if y >= 0.0 else (3, -y, x)
    slope = int((across / along + 1.0) * (_SLOPES / 2))
    return face, min(slope, _SLOPES - 1), along


@compiled
def horizons(
    looks: np.ndarray,
    rows_away: np.ndarray,
    columns_away: np.ndarray,
    reach: float = np.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds, by direction, within which :func:`goal_in_sight` is known without a look.

    Seen from the goal, cells are behind one of the four sides of a square, at a slope.
    A cell ``hidden`` or more cells along has a cell in between that a look surely falls
    into and that is not fast. A cell at most ``clear`` cells along is nearer than anything
    that a look may find. Cells between the two must look.

    Args:
        looks: As from :func:`sure_looks`, ``[R, C]``.
        rows_away: Rows from each row to the goal, ``[R]``.
        columns_away: Columns from each column to the goal, ``[C]``.
        reach: Largest distance from the goal of cells that are asked for, in cells.

    Returns:
        ``hidden`` and ``clear``, in cells, ``[4, slopes]``.
    """
    hidden, clear = np.full((4, _SLOPES), np.inf), np.full((4, _SLOPES), np.inf)
    # For a goal in the outermost half cell looks may fall outside the grid.
    if min(rows_away[0], columns_away[0], -rows_away[-1], -columns_away[-1]) < 0.0:
        clear[:] = 0.0
    rows, columns = looks.shape
    first_r, last_r = _rows_within(rows_away, reach + 2.0)
    first_c, last_c = _rows_within(columns_away, reach + 2.0)
    for r in range(first_r, last_r + 1):
        for c in range(first_c, last_c + 1):
            if looks[r, c] >= 2:
                continue
            # A cell that is behind others on all sides hides nothing more.
            above, below = looks[max(r - 1, 0), c], looks[min(r + 1, rows - 1), c]
            left, right = looks[r, max(c - 1, 0)], looks[r, min(c + 1, columns - 1)]
            if max(above, below, left, right) < 2:
                continue
            y, x = -rows_away[r], -columns_away[c]
            _hide(0, x, y, hidden, clear)
            _hide(1, -x, y, hidden, clear)
            _hide(2, y, x, hidden, clear)
            _hide(3, -y, x, hidden, clear)
    return hidden, clear


@compiled
def _hide(
    face: int, along: float, across: float, hidden: np.ndarray, clear: np.ndarray
) -> None:
    """Lower the horizons behind a side for what a cell that is not fast hides there."""
    # A look that falls into it, or cuts its corner, is within 1.12 cells of its middle.
    if along < -1.3:
        return
    if along < 1.8:
        if abs(across) < 3.5:
            clear[face] = 0.0
        return
    middle, scale = (across / along + 1.0) * (_SLOPES / 2), _SLOPES / 2 / along
    # 1.12 cells from a line are at most sqrt(2) times as many across it.
    first, last = middle - 1.75 * scale, middle + 1.75 * scale
    if last < 0.0 or first >= _SLOPES:
        return
    for n in range(int(max(first, 0.0)), int(min(last, _SLOPES - 1.0)) + 1):
        clear[face, n] = min(clear[face, n], along - 1.3)
    # A line this near to its middle is in it for more than half a cell, so a look is too.
    first, last = math.ceil(middle - 0.45 * scale), math.floor(middle + 0.45 * scale)
    for n in range(max(first, 0), min(last, _SLOPES)):
        hidden[face, n] = min(hidden[face, n], along + 0.75)


@compiled
def _arrival_from_neighbours(arrival: np.ndarray, r: int, c: int, step: float) -> float:
    """Time of a cell from the earlier of the cells at its sides, a step apart."""
    a = min(arrival[r, c + 1], arrival[r + 2, c + 1])
    b = min(arrival[r + 1, c], arrival[r + 1, c + 2])
    low, high = min(a, b), max(a, b)
    # Both are infinite before any way leads here, and then their difference is NaN.
    if not high - low < step:
        return low + step
    gap = high - low
    return 0.5 * (low + high + math.sqrt(2.0 * step * step - gap * gap))
