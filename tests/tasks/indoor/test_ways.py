"""Shortcuts of the search for ways, against the same search without them."""

import itertools
import math

import numpy as np
import pytest

from gdrl_tasks.indoor.arena import ARENAS
from gdrl_tasks.indoor.free_space import CELL_M, FreeSpace
from gdrl_tasks.indoor.ways import fast_sweep, goal_in_sight, horizons, sure_looks

FOOTPRINT_M = 0.115
every_arena = pytest.mark.parametrize("arena", list(ARENAS))


@every_arena
def test_a_goal_is_in_sight_if_every_look_on_the_way_finds_room(arena):
    own = ARENAS[arena]()
    generator = np.random.default_rng(6)
    seen = []
    for _ in range(4):
        places = own.draw(generator, FOOTPRINT_M, 0.15).places
        space = FreeSpace.of(own.half_extent_m, own.shapes, places)
        spare = (space.clearance - FOOTPRINT_M) / CELL_M
        free, fast = 0.5, generator.choice([0.5, 2.0])
        looks = sure_looks(spare, free, fast)
        for row, column in np.argwhere(spare >= free)[::7]:
            away = generator.uniform(0, len(space.y)), generator.uniform(0, len(space.x))
            away = away[0] - row, away[1] - column
            found = goal_in_sight(looks, row, column, *away)
            assert found == sees(spare, free, fast, (row, column), away)
            seen.append(found)
    assert 0.1 < np.mean(seen) < 0.9


@every_arena
def test_what_is_seen_without_a_look_is_what_looks_see(arena):
    own = ARENAS[arena]()
    generator = np.random.default_rng(7)
    cells = without = 0
    for number in range(6):
        places = own.draw(generator, FOOTPRINT_M, 0.15).places
        space = FreeSpace.of(own.half_extent_m, own.shapes, places)
        spare = (space.clearance - FOOTPRINT_M) / CELL_M
        looks = sure_looks(spare, 0.5, generator.choice([0.5, 2.0]))
        rows, columns = looks.shape
        # The last goals are anywhere: within walls, or in the outermost half cells.
        goal = generator.uniform(-0.5, [rows - 0.5, columns - 0.5])
        if number < 4:
            free = np.argwhere(looks >= 2)
            goal = generator.choice(free) + generator.uniform(-0.5, 0.5, size=2)
        rows_away, columns_away = goal[0] - np.arange(rows), goal[1] - np.arange(columns)
        hidden, clear = horizons(looks, rows_away, columns_away)
        for row, column in np.argwhere(looks):
            away = rows_away[row], columns_away[column]
            face, slope, along = side_of(-away[0], -away[1], hidden.shape[1])
            found = goal_in_sight(looks, row, column, *away)
            if along <= clear[face, slope]:
                assert found, (row, column)
            elif along >= hidden[face, slope]:
                assert not found, (row, column)
            else:
                known = clear[face, slope] / along
                assert goal_in_sight(looks, row, column, *away, known) == found
            cells += 1
            without += along <= clear[face, slope] or along >= hidden[face, slope]
    assert without > 0.6 * cells


def side_of(y, x, count):
    """East, west, north or south of a goal; the slope's bin; the distance along."""
    face = int(x < 0) if abs(x) >= abs(y) else 2 + int(y < 0)
    along, across = (abs(x), y) if face < 2 else (abs(y), x)
    slope = int((across / along + 1.0) / 2.0 * count) if along else 0
    return face, min(slope, count - 1), along


@every_arena
@pytest.mark.parametrize("comfort_m", [0.0, 0.3])
def test_cells_that_are_left_out_of_a_sweep_would_not_change(arena, comfort_m):
    own = ARENAS[arena]()
    generator = np.random.default_rng(8)
    scene = own.draw(generator, FOOTPRINT_M, 0.15)
    space = FreeSpace.of(own.half_extent_m, own.shapes, scene.places)
    found = space.distances_to(scene.goal, FOOTPRINT_M, comfort_m=comfort_m)
    spare = (space.clearance - FOOTPRINT_M) / CELL_M
    speed = np.ones_like(spare)
    if comfort_m:
        speed = np.clip(spare / (comfort_m / CELL_M), 0.2, 1.0)
    looks = sure_looks(spare, 0.5, max(0.5, comfort_m / CELL_M))
    away_y, away_x = scene.goal[1] - space.y, scene.goal[0] - space.x
    expected = swept(looks, speed, away_x, away_y)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)


@every_arena
def test_ways_within_reach_do_not_depend_on_what_is_beyond(arena):
    own = ARENAS[arena]()
    generator = np.random.default_rng(9)
    for _ in range(10):
        scene = own.draw(generator, FOOTPRINT_M, 0.15)
        space = FreeSpace.of(own.half_extent_m, own.shapes, scene.places)
        looks = sure_looks((space.clearance - FOOTPRINT_M) / CELL_M, 0.5, 0.5)
        away = scene.goal[0] - space.x, scene.goal[1] - space.y
        speed = np.ones_like(space.clearance)
        whole = fast_sweep(looks, speed, *away, CELL_M, 16, np.inf)
        for reach in generator.uniform(0.2, 8.0, size=5):
            found = fast_sweep(looks, speed, *away, CELL_M, 16, reach)
            within = whole <= reach
            np.testing.assert_array_equal(found[within], whole[within])
            assert (found[~within] > reach).all()


@every_arena
def test_the_way_of_one_start_is_that_of_its_cell(arena):
    own = ARENAS[arena]()
    generator = np.random.default_rng(10)
    ratios = []
    for _ in range(6):
        scene = own.draw(generator, FOOTPRINT_M, 0.15)
        space = FreeSpace.of(own.half_extent_m, own.shapes, scene.places)
        ways = space.distances_to(scene.goal, FOOTPRINT_M)
        # Also starts within walls, from which there is no way, and outside of the arena.
        half = np.array(own.half_extent_m) + 0.2
        for start in generator.uniform(-half, half, size=(60, 2)):
            row, column = space.cells(start)
            way = space.distance(start, scene.goal, FOOTPRINT_M)
            assert way == pytest.approx(ways[row, column], rel=1e-12)
            x, y = space.x[column], space.y[row]
            ratios.append(way / math.hypot(scene.goal[0] - x, scene.goal[1] - y))
    longest = max(ratio for ratio in ratios if math.isfinite(ratio))
    # Straight ones, such as are found at the first try and, in one arena, others.
    assert min(ratios) < 1.0 + 1e-9
    assert longest > (1.6 if arena == "paper" else 1.05)
    assert any(map(math.isinf, ratios))


def swept(looks, speed, away_x, away_y):
    """Every free cell at every sweep, in plain Python."""
    rows, columns = looks.shape
    times = np.full((rows + 2, columns + 2), np.inf)
    for r, c in np.argwhere(looks):
        exact = math.hypot(away_x[c], away_y[r])
        if exact <= 1.5 * CELL_M:
            times[r + 1, c + 1] = exact / speed[r, c]
        elif goal_in_sight(looks, r, c, away_y[r] / CELL_M, away_x[c] / CELL_M):
            times[r + 1, c + 1] = exact
    for number in range(64):
        before = times.copy()
        rows_in_turn = range(rows)[:: 1 if number % 4 < 2 else -1]
        columns_in_turn = range(columns)[:: 1 if number % 2 == 0 else -1]
        for r, c in itertools.product(rows_in_turn, columns_in_turn):
            if looks[r, c]:
                beside = min(times[r + 1, c], times[r + 1, c + 2])
                above = min(times[r, c + 1], times[r + 2, c + 1])
                new = arrival(*sorted((above, beside)), CELL_M / speed[r, c])
                if new < times[r + 1, c + 1] - 1e-9:
                    times[r + 1, c + 1] = new
        if np.array_equal(times, before):
            break
    return times[1:-1, 1:-1]


def arrival(low, high, step):
    """Where the gradient has the length 1 by the step, from two sides or from one."""
    if math.isinf(low) or high - low >= step:
        return low + step
    gap = high - low
    return 0.5 * (low + high + math.sqrt(2.0 * step * step - gap * gap))


def sees(spare, free, fast, start, away):
    """A look every half cell, none left out."""
    count = int(2.0 * np.hypot(*away)) + 1
    fractions = np.arange(count) / count
    cells = np.array(start) + fractions[:, None] * away
    # A goal in the outermost half cell may round to beyond the grid.
    cells = np.floor(cells + 0.5).astype(int)
    inside = np.all((cells >= 0) & (cells < spare.shape), axis=1)
    if not inside.all() or (spare[tuple(cells.T)] < fast).any():
        return False
    one, other = cells[:-1].T, cells[1:].T
    return not ((spare[one[0], other[1]] < free) & (spare[other[0], one[1]] < free)).any()
