"""Distances to obstacles, and lengths of ways round them, against brute force."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import label
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

import gdrl_tasks
from gdrl_tasks.indoor.arena import ARENAS
from gdrl_tasks.indoor.definition import clearance
from gdrl_tasks.indoor.free_space import CELL_M, FreeSpace
from gdrl_tasks.indoor.kernel import clearances
from gdrl_tasks.indoor.obstacles import make_shapes, place

FOOTPRINT_M = 0.115
FINE_M = 0.025
every_arena = pytest.mark.parametrize("arena", list(ARENAS))


def outline(is_box, half_size, at, spacing_m):
    """Points on the boundary of a shape, ``[P, 2]``."""
    if not is_box:
        count = int(2.0 * np.pi * half_size[0] / spacing_m) + 8
        angle = np.linspace(0.0, 2.0 * np.pi, count)
        own = half_size[0] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    else:
        corners = half_size * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]])
        own = np.concatenate(
            [
                np.linspace(a, b, int(np.linalg.norm(b - a) / spacing_m) + 2)
                for a, b in itertools.pairwise(corners)
            ]
        )
    turn = np.array([[at[2], -at[3]], [at[3], at[2]]])
    return own @ turn.T + at[:2]


def is_inside(points, is_box, half_size, at):
    """Mask of points ``[P, 2]`` inside a shape."""
    offset = points - at[:2]
    if not is_box:
        return (offset**2).sum(axis=-1) < half_size[0] ** 2
    # Left of all four sides, which go round to the left.
    along, across = np.array(at[2:]), np.array([-at[3], at[2]])
    inside = np.ones(len(points), dtype=bool)
    for normal, reach in (
        (along, half_size[0]),
        (-along, half_size[0]),
        (across, half_size[1]),
        (-across, half_size[1]),
    ):
        inside &= offset @ normal < reach
    return inside


def room_by_sampling(points, places, shapes, spacing_m):
    """Distances of points to the nearest surface, negative inside, by brute force."""
    nearest = np.full(len(points), np.inf)
    for is_box, half_size, at in zip(shapes.is_box, shapes.half_size, places, strict=True):
        surface = outline(is_box, half_size, at, spacing_m)
        distance = np.linalg.norm(points[:, None] - surface, axis=-1).min(axis=1)
        inside = is_inside(points, is_box, half_size, at)
        nearest = np.minimum(nearest, np.where(inside, -distance, distance))
    return nearest


def random_shapes(generator):
    boxes = [tuple(generator.uniform(0.05, 1.2, 2)) for _ in range(3)]
    shapes = make_shapes(boxes, list(generator.uniform(0.05, 0.6, 2)), 0.3)
    x, y = generator.uniform(-2.0, 2.0, (2, 5))
    return shapes, place(x, y, generator.uniform(-np.pi, np.pi, 5))


@pytest.mark.parametrize("seed", range(4))
def test_clearance_is_the_distance_to_the_nearest_point_of_a_surface(seed):
    generator = np.random.default_rng(seed)
    shapes, places = random_shapes(generator)
    points = generator.uniform(-3.0, 3.0, (150, 2))
    spacing = 5e-4
    expected = room_by_sampling(points, places, shapes, spacing)
    around = np.broadcast_to(places, (150, 5, 4))
    found = clearance(points, around, shapes.is_box, shapes.half_size)
    # The nearest sample is at most half a spacing from the nearest point.
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=0.5 * spacing)
    assert 10 < (found < 0.0).sum() < 120


def test_clearance_of_a_point_on_a_surface_is_zero():
    shapes, places = random_shapes(np.random.default_rng(9))
    for number in range(5):
        is_box = shapes.is_box[number : number + 1]
        half_size = shapes.half_size[number : number + 1]
        points = outline(is_box[0], half_size[0], places[number], 0.05)
        around = np.broadcast_to(places[number], (len(points), 1, 4))
        room = clearance(points, around, is_box, half_size)
        np.testing.assert_allclose(room, 0.0, atol=1e-12)


@every_arena
def test_the_compiled_clearances_are_the_array_function(arena):
    generator = np.random.default_rng(0)
    own = ARENAS[arena]()
    layouts = np.stack(
        [
            own.draw(np.random.default_rng(seed), FOOTPRINT_M, 0.15).places
            for seed in range(7)
        ]
    )
    which = generator.integers(7, size=3000)
    points = generator.uniform(-6.0, 6.0, (3000, 2))
    shapes = own.shapes
    expected = clearance(points, layouts[which], shapes.is_box, shapes.half_size)
    found = clearances(points, which, layouts, shapes.is_box, shapes.half_size)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)


@every_arena
def test_the_clearances_of_a_grid_are_the_array_function(arena):
    own = ARENAS[arena]()
    places = own.draw(np.random.default_rng(5), FOOTPRINT_M, 0.15).places
    space = FreeSpace.of(own.half_extent_m, own.shapes, places)
    points = np.stack(np.meshgrid(space.x, space.y), axis=-1).reshape(-1, 2)
    around = np.broadcast_to(places, (len(points), *places.shape))
    expected = clearance(points, around, own.shapes.is_box, own.shapes.half_size)
    np.testing.assert_allclose(space.clearance.ravel(), expected, rtol=0.0, atol=1e-12)


@given(seed=st.integers(0, 2**32))
def test_compiled_clearances_agree_for_any_shapes_at_any_yaw(seed):
    generator = np.random.default_rng(seed)
    shapes, places = random_shapes(generator)
    points = np.concatenate([generator.uniform(-3.0, 3.0, (30, 2)), places[:, :2]])
    layouts = np.zeros(len(points), dtype=np.int64)
    expected = clearance(
        points,
        np.broadcast_to(places, (len(points), 5, 4)),
        shapes.is_box,
        shapes.half_size,
    )
    found = clearances(points, layouts, places[None], shapes.is_box, shapes.half_size)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)


def test_torch_measures_the_same_clearance_as_numpy():
    torch = pytest.importorskip("torch")
    shapes, places = random_shapes(np.random.default_rng(3))
    points = np.random.default_rng(4).uniform(-3.0, 3.0, (40, 2))
    arguments = (points, np.tile(places, (40, 1, 1)), shapes.is_box, shapes.half_size)
    found = clearance(*map(torch.as_tensor, arguments))
    np.testing.assert_allclose(found.numpy(), clearance(*arguments), rtol=0.0, atol=1e-12)


class FineGrid:
    """A layout on a fine grid of our own: where a disc's middle may be, and ways."""

    def __init__(self, arena, places):
        half_x, half_y = arena.half_extent_m
        self.x, self.y = (
            (np.arange(round(2.0 * half / FINE_M)) + 0.5) * FINE_M - half
            for half in (half_x, half_y)
        )
        x, y = np.meshgrid(self.x, self.y)
        points = np.stack([x.ravel(), y.ravel()], axis=-1)
        room = np.minimum(half_x - np.abs(points[:, 0]), half_y - np.abs(points[:, 1]))
        obstacles = zip(
            arena.shapes.is_box[4:], arena.shapes.half_size[4:], places[4:], strict=True
        )
        for is_box, half_size, at in obstacles:
            if np.hypot(*at[:2]) < 20.0:
                room = np.minimum(room, distance_to_shape(points, is_box, half_size, at))
        self.room = room.reshape(x.shape)

    def cell(self, points):
        """Rows and columns of the cells that hold points ``[..., 2]``."""
        column = np.floor((points[..., 0] - self.x[0]) / FINE_M + 0.5).astype(int)
        row = np.floor((points[..., 1] - self.y[0]) / FINE_M + 0.5).astype(int)
        return row.clip(0, len(self.y) - 1), column.clip(0, len(self.x) - 1)

    def reachable(self, goal, least_room):
        """Flood fill: cells joined to the goal's, corners included, ``[R, C]``."""
        areas, _ = label(self.room > least_room, np.ones((3, 3)))
        area = areas[self.cell(goal)]
        return (areas == area) & (area > 0)

    def lengths(self, goal, least_room):
        """Dijkstra's lengths of ways to a goal over 32 neighbours, ``[R, C]``."""
        free = self.room > least_room
        number = np.arange(free.size).reshape(free.shape)
        rows, columns, weights = [], [], []
        for down, right in _knight_moves():
            height, width = free.shape[0] - down, free.shape[1] - abs(right)
            left = max(0, -right)
            here = (slice(0, height), slice(left, left + width))
            there = (slice(down, down + height), slice(left + right, left + right + width))
            both = free[here] & free[there]
            rows.append(number[here][both])
            columns.append(number[there][both])
            weights.append(np.full(both.sum(), FINE_M * np.hypot(down, right)))
        entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
        graph = coo_matrix(entries, shape=(free.size, free.size)).tocsr()
        found = dijkstra(graph, directed=False, indices=number[self.cell(goal)])
        return found.reshape(free.shape)


def _knight_moves():
    """Half of the 32 nearest directions; the graph goes both ways."""
    moves = [(0, 1), (1, 0), (1, 1), (1, -1)]
    for a, b in ((1, 2), (1, 3), (2, 3)):
        moves += [(a, b), (b, a), (a, -b), (b, -a)]
    return moves


def distance_to_shape(points, is_box, half_size, at):
    """Distances to a shape, zero inside it."""
    offset = points - at[:2]
    if not is_box:
        return np.maximum(np.linalg.norm(offset, axis=1) - half_size[0], 0.0)
    own = offset @ np.array([[at[2], -at[3]], [at[3], at[2]]])
    return np.linalg.norm(own - own.clip(-half_size, half_size), axis=1)


def middles(space):
    """Middles of the cells, ``[R, C, 2]``."""
    return np.stack(np.meshgrid(space.x, space.y), axis=-1)


def drawn(arena, seed):
    """An arena, the free space of a drawn layout, the layout and its goal."""
    own = ARENAS[arena]()
    scene = own.draw(np.random.default_rng(seed), FOOTPRINT_M, 0.15)
    space = FreeSpace.of(own.half_extent_m, own.shapes, scene.places)
    return own, space, scene.places, scene.goal


@every_arena
def test_a_grid_holds_the_clearance_of_its_cells(arena):
    own, space, places, _ = drawn(arena, 0)
    half_x, half_y = own.half_extent_m
    assert space.clearance.shape == (round(2.0 * half_y / 0.1), round(2.0 * half_x / 0.1))
    assert space.x[[0, -1]] == pytest.approx([0.05 - half_x, half_x - 0.05])
    assert space.y[[0, -1]] == pytest.approx([0.05 - half_y, half_y - 0.05])
    points = middles(space).reshape(-1, 2)
    chosen = np.random.default_rng(0).integers(len(points), size=200)
    near = np.hypot(*places[:, :2].T) < 20.0
    shapes = dataclasses.replace(
        own.shapes, is_box=own.shapes.is_box[near], half_size=own.shapes.half_size[near]
    )
    expected = room_by_sampling(points[chosen], places[near], shapes, 2e-3)
    found = space.clearance.ravel()[chosen]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-3)


@every_arena
def test_points_are_in_the_cells_whose_middles_are_nearest(arena):
    own, space, _, _ = drawn(arena, 0)
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 2)) * own.half_extent_m
    middle = middles(space)[space.cells(points)]
    assert np.abs(middle - points).max() <= 0.05 + 1e-9
    outside = np.array([[20.0, 0.0], [-20.0, -20.0]])
    rows, columns = space.cells(outside)
    assert (columns == [len(space.x) - 1, 0]).all()
    assert rows[1] == 0


@pytest.mark.parametrize("goal", [(0.0, 0.0), (2.31, -1.07), (-3.2, 3.3)])
def test_ways_in_the_open_are_straight(goal):
    own = ARENAS["scatter"]()
    places = own.draw(np.random.default_rng(0), FOOTPRINT_M, 0.15).places.copy()
    places[4:, :2] = 100.0
    space = FreeSpace.of(own.half_extent_m, own.shapes, places)
    ways = space.distances_to(np.array(goal), FOOTPRINT_M)
    free = space.clearance >= FOOTPRINT_M + 0.5 * CELL_M
    straight = np.linalg.norm(middles(space) - goal, axis=-1)
    np.testing.assert_allclose(ways[free], straight[free], rtol=1e-12)
    assert np.isinf(ways[~free]).all()


@every_arena
@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.full)])
def test_ways_are_as_long_as_dijkstra_says_on_a_fine_grid(arena, seed):
    own, space, places, goal = drawn(arena, seed)
    ways = space.distances_to(goal, FOOTPRINT_M)
    fine = FineGrid(own, places)
    cell = fine.cell(middles(space))
    found = np.isfinite(ways)
    # Its own ways are up to 1.3 % too long and begin and end 2 cm away.
    shortest = fine.lengths(goal, FOOTPRINT_M)[cell]
    assert (ways[found] >= 0.985 * shortest[found] - 0.03).all()
    # A way with a cell's half diagonal and half a cell to spare is on the grid too.
    spacious = fine.lengths(goal, FOOTPRINT_M + 0.5 * CELL_M + 0.071)[cell]
    has_room = np.isfinite(spacious)
    assert has_room.sum() > 300
    assert (ways[has_room] <= 1.05 * spacious[has_room] + 0.1).all()
    assert ways[found].mean() <= 1.06 * shortest[found].mean()


def nearly_closed(arena, places, number):
    """Obstacles that leave gaps about as wide as the robot, and a goal behind them."""
    places = places.copy()
    if arena == "corridor":
        # From wall to wall but for a gap of 10 to 43 cm.
        places[4:7, :2] = [(0.0, 1.05), (0.0, -0.45 - 0.03 * number), (0.0, -1.2)]
        return places, np.array([4.5, 0.0])
    if arena == "paper":
        # Four blocks around the middle, gaps of 10 to 43 cm at their ends.
        apart = 1.1 + 0.15 + 0.1 + 0.03 * number
        places[4:, :2] = [(0.0, 1.35), (0.0, -1.35), (apart, 0.0), (-apart, 0.0)]
        return places, np.array([0.1, -0.3])
    if arena == "trap":
        # At a wall, gaps of 10 to 43 cm between the ends of its sides and its bottom.
        apart = 2.35 - 0.1 - 0.03 * number
        places[4:] = place([apart, 2.95, 2.95], [0.0, 1.15, -1.15])
        return places, np.array([3.0, 0.0])
    # A ring of ten.
    angle = np.arange(10) * 0.2 * np.pi
    ring = (0.55 + 0.06 * number) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    places[4:] = place(ring[:, 0], ring[:, 1], angle + 0.5 * np.pi)
    return places, np.array([0.03, 0.02])


@every_arena
def test_no_way_leads_where_a_flood_fill_does_not(arena):
    shut, passed = 0, 0
    for number in range(12):
        own, _, places, _ = drawn(arena, number)
        places, goal = nearly_closed(arena, places, number)
        space = FreeSpace.of(own.half_extent_m, own.shapes, places)
        found = np.isfinite(space.distances_to(goal, FOOTPRINT_M))
        fine = FineGrid(own, places)
        # Generous by half a cell's diagonal: every way there is goes through its cells.
        flooded = fine.reachable(goal, FOOTPRINT_M - 0.71 * FINE_M)
        flooded = flooded[fine.cell(middles(space))]
        assert not (found & ~flooded).any()
        roomy = space.clearance > 0.2
        shut += bool((roomy & ~flooded).any())
        passed += bool((roomy & found).sum() > 0.8 * roomy.sum())
    # Else the gaps say nothing.
    assert shut >= 3
    assert passed >= 1


@every_arena
def test_every_goal_that_is_drawn_can_be_reached_from_its_start(arena, indoor_pose):
    task = gdrl_tasks.make_task("indoor", arena=arena)
    for seed in range(12):
        episode = task.draw_episode(100 + seed)
        (start,), _ = indoor_pose(episode.qpos[None])
        goal = episode.arrays["goal"]
        fine = FineGrid(task.arena, episode.arrays["obstacles"])
        flooded = fine.reachable(goal, FOOTPRINT_M)
        assert flooded[fine.cell(start)]
        if seed < 3:
            # And the way is as long as Dijkstra's, a tenth at most for the coarse grid, and
            # a bit more where it bends around the walls of the trap.
            most = 1.15 if arena == "trap" else 1.1
            length = fine.lengths(goal, FOOTPRINT_M)[fine.cell(start)]
            shortest = episode.arrays["shortest_path"]
            assert 0.98 * length - 0.05 <= shortest <= most * length + 0.1


@every_arena
def test_a_comfortable_way_takes_longer_near_obstacles_only(arena):
    _, space, _, goal = drawn(arena, 1)
    plain = space.distances_to(goal, FOOTPRINT_M)
    comfortable = space.distances_to(goal, FOOTPRINT_M, comfort_m=0.3)
    np.testing.assert_array_equal(np.isfinite(plain), np.isfinite(comfortable))
    found = np.isfinite(plain) & (plain > 0.2)
    ratio = comfortable[found] / plain[found]
    assert ratio.min() >= 0.999
    assert ratio.max() <= 5.001
    assert ratio.max() > 1.5
    slightly = space.distances_to(goal, FOOTPRINT_M, comfort_m=0.15)
    assert (slightly[found] <= comfortable[found] + 1e-9).all()


def test_the_wider_the_disc_the_longer_the_way():
    own = ARENAS["paper"]()
    places = own.draw(np.random.default_rng(0), FOOTPRINT_M, 0.15).places.copy()
    # A wall across the room with a gap of 0.5 m, and one of 0.9 m farther away.
    places[4:] = [
        (-2.4, 0.0, 1.0, 0.0),
        (0.3, 0.0, 1.0, 0.0),
        (3.4, 0.0, 0.0, 1.0),
        (0.0, 100.0, 1.0, 0.0),
    ]
    space = FreeSpace.of(own.half_extent_m, own.shapes, places)
    start = space.cells(np.array([-1.05, -1.05]))
    goal = np.array([-1.05, 0.95])
    ways = [space.distances_to(goal, radius)[start] for radius in (0.1, 0.15, 0.3, 0.35)]
    assert ways[:2] == pytest.approx([2.0, 2.0])
    # Past the block's end at (1.4, 0) by the radius, and back.
    assert 2.0 * np.hypot(2.45, 1.0) < ways[2] < ways[3] < 7.5
    assert np.isinf(space.distances_to(goal, 0.5)[start])
