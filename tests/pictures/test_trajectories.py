"""Figures of trajectories show where vehicles went, and what was in their way."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection, PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from matplotlib.transforms import BboxBase
from PIL import Image

from gdrl_torchrl.pictures import style
from gdrl_torchrl.pictures.figures import draw_trajectories
from gdrl_torchrl.pictures.layout import Layout, posed
from gdrl_torchrl.pictures.trajectories import make_trajectories, view_reach


@pytest.mark.parametrize("recorded", ["trajectories", "arena_trajectories"])
def test_trajectories_are_written(
    tmp_path: Path, recorded: str, request: pytest.FixtureRequest
) -> None:
    trajectories = request.getfixturevalue(recorded)
    np.savez(tmp_path / "trajectories.npz", allow_pickle=False, **trajectories)

    path = draw_trajectories(tmp_path)

    assert path == tmp_path / "figures" / "trajectories.png"
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert image.format == "PNG"
    assert min(pixels.shape[:2]) > 500
    assert pixels.std() > 5


def test_paths_are_coloured_and_counted_by_outcome(
    trajectories: dict[str, np.ndarray],
) -> None:
    axes = make_trajectories(trajectories).axes[0]

    paths = {
        str(item.get_label()): item
        for item in axes.collections
        if isinstance(item, LineCollection)
    }
    assert list(paths) == ["success (2)", "timeout (1)"]
    for label, item in paths.items():
        colour = to_hex(item.get_color()[0])
        assert colour.upper() == style.OUTCOME_COLOURS[label.split()[0]]
    ends = [segment[-1].tolist() for segment in paths["success (2)"].get_segments()]
    assert ends == [[4.0, 0.0], [0.0, 2.0]]


def test_goals_are_circles_of_the_tolerance(trajectories: dict[str, np.ndarray]) -> None:
    axes = make_trajectories(trajectories).axes[0]

    rings = [item for item in axes.collections if isinstance(item, PatchCollection)]
    boxes = [path.get_extents() for item in rings for path in item.get_paths()]
    centres = [[0.5 * (b.x0 + b.x1), 0.5 * (b.y0 + b.y1)] for b in boxes]
    np.testing.assert_allclose(centres, trajectories["goal"], atol=1e-9)
    np.testing.assert_allclose([b.width for b in boxes], 0.6)
    assert axes.get_aspect() == 1.0


def test_sea_lies_under_the_paths_with_x_to_the_right(
    trajectories: dict[str, np.ndarray],
) -> None:
    slope = trajectories["sea_x"][None, :] + 2.0 * trajectories["sea_y"][:, None]
    figure = make_trajectories(trajectories | {"sea_elevation": slope})

    image = figure.axes[0].images[0]
    assert image.origin == "lower"
    np.testing.assert_allclose(image.get_extent(), [-7, 7, -7, 7])
    np.testing.assert_allclose(np.asarray(image.get_array()), slope)
    assert figure.axes[1].get_ylabel() == "elevation of the surface (m)"


@pytest.mark.parametrize("sea", ["none", "flat"])
def test_still_water_has_no_colour_bar(
    trajectories: dict[str, np.ndarray], sea: str
) -> None:
    if sea == "none":
        del trajectories["sea_elevation"]
    else:
        trajectories["sea_elevation"] = np.zeros((50, 50))

    figure = make_trajectories(trajectories)

    assert len(figure.axes) == 1


def test_boat_that_wandered_off_does_not_shrink_the_picture(
    trajectories: dict[str, np.ndarray],
) -> None:
    near = view_reach(trajectories)
    trajectories["position"][:, 2] *= 100.0

    far = view_reach(trajectories)

    assert near == pytest.approx(6.3)
    assert far == pytest.approx(1.5 * 5.3 + 1.0)


def test_arena_is_in_the_view_whatever_its_shape(
    arena_trajectories: dict[str, np.ndarray],
) -> None:
    arena_trajectories["position"] *= 100.0

    # Outside of the walls, which are 0.1 m thick, there are 0.2 m of floor.
    assert view_reach(arena_trajectories, aspect=2.0) == pytest.approx(2.3)
    assert view_reach(arena_trajectories, aspect=1.0) == pytest.approx(3.3)


def test_every_episode_among_obstacles_has_a_panel_with_its_own(
    arena_trajectories: dict[str, np.ndarray],
) -> None:
    figure = make_trajectories(arena_trajectories)

    panels = [axes for axes in figure.axes if axes.get_visible()]
    titles = [axes.get_title() for axes in panels]
    assert titles == [
        "1: success after 1.0 s",
        "2: success after 0.5 s",
        "3: timeout after 1.5 s",
    ]
    for number, axes in enumerate(panels):
        (path,) = [c for c in axes.collections if isinstance(c, LineCollection)]
        steps = arena_trajectories["steps"][number]
        expected = arena_trajectories["position"][: steps + 1, number]
        np.testing.assert_allclose(path.get_segments()[0], expected)
        colour = style.OUTCOME_COLOURS[titles[number].split()[1]]
        assert to_hex(path.get_color()[0]).upper() == colour
    boxes = [_boxes(axes)[0].mean(axis=0) for axes in panels]
    np.testing.assert_allclose(boxes, [[1, -1], [1, 1], [-1, 1]], atol=1e-9)
    pillars = [_pillars(axes) for axes in panels]
    assert pillars == [[(-2.0, 1.0, 0.3)], [(-2.0, 1.0, 0.3)], []]


def test_slanted_box_has_its_corners_where_they_are(
    arena_trajectories: dict[str, np.ndarray],
) -> None:
    axes = make_trajectories(arena_trajectories).axes[1]

    corners = _boxes(axes)[0]
    along = np.array([np.cos(0.5), np.sin(0.5)])
    offset = corners - [1.0, 1.0]
    np.testing.assert_allclose(np.abs(offset @ along), 0.6)
    np.testing.assert_allclose(np.abs(offset @ [-along[1], along[0]]), 0.2)


def test_vehicle_stands_at_the_end_to_scale(
    arena_trajectories: dict[str, np.ndarray],
) -> None:
    arena_trajectories["heading"][4, 0] = 0.5 * np.pi

    axes = make_trajectories(arena_trajectories).axes[0]

    vehicle = _polygons(axes, style.OUTCOME_COLOURS["success"])[0]
    # Its middle is 3 cm behind the position, and it heads along y.
    np.testing.assert_allclose(vehicle.mean(axis=0), [2.0, -0.03], atol=1e-9)
    np.testing.assert_allclose(np.ptp(vehicle, axis=0), 0.22, atol=1e-3)


@pytest.mark.parametrize(
    ("episodes", "half_extent", "rows_and_columns"),
    [(1, [3.0, 2.5], (1, 1)), (9, [3.0, 2.5], (2, 4)), (7, [5.0, 1.7], (4, 2))],
)
def test_panels_fill_the_page_and_nothing_overlaps(
    arena_trajectories: dict[str, np.ndarray],
    episodes: int,
    half_extent: list[float],
    rows_and_columns: tuple[int, int],
) -> None:
    data = _repeated(arena_trajectories, episodes)
    data["half_extent"] = np.array(half_extent)

    figure = make_trajectories(data)

    grid = figure.axes[0].get_gridspec()
    assert (grid.nrows, grid.ncols) == rows_and_columns
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert len(panels) == min(episodes, 8)
    assert not _overlaps(figure)
    for axes in panels:
        x, y = axes.get_xlim(), axes.get_ylim()
        assert x == pytest.approx((-half_extent[0] - 0.3, half_extent[0] + 0.3))
        assert y == pytest.approx((-half_extent[1] - 0.3, half_extent[1] + 0.3))


def test_title_counts_the_episodes_that_have_no_panel(
    arena_trajectories: dict[str, np.ndarray],
) -> None:
    few, many = (make_trajectories(_repeated(arena_trajectories, n)) for n in (1, 10))

    assert few.get_suptitle() == "1 episode from above"
    expected = "The first 8 of 10 episodes from above (of all: 7 success, 3 timeout)"
    assert many.get_suptitle() == expected
    legend = [text.get_text() for text in many.legends[0].get_texts()]
    assert legend == ["success (6)", "timeout (2)", "start", "goal, within 0.3 m"]


def test_layout_leaves_out_what_an_episode_does_not_use(
    trajectories: dict[str, np.ndarray], arena_trajectories: dict[str, np.ndarray]
) -> None:
    with_pillar, without = (Layout.of(arena_trajectories, k) for k in (0, 2))

    assert Layout.of(trajectories, 0) is None
    assert with_pillar is not None
    assert without is not None
    assert with_pillar.is_box.tolist() == [True] * 5 + [False]
    assert without.is_box.tolist() == [True] * 5
    assert without.places.shape == (5, 4)
    assert without.half_size_m.shape == (5, 2)


def test_posed_turns_before_it_moves() -> None:
    points = np.array([[1.0, 0.0], [0.0, 1.0]])

    turned = posed(points, np.array([2.0, 3.0]), np.pi / 6)

    expected = [[2.0 + np.sqrt(0.75), 3.5], [1.5, 3.0 + np.sqrt(0.75)]]
    np.testing.assert_allclose(turned, expected)


def _repeated(trajectories: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """The same episodes again and again."""
    chosen = np.arange(count) % 3
    by_step = {name: trajectories[name][:, chosen] for name in ("position", "heading")}
    names = ("goal", "outcome", "steps", "episode_seed", "obstacles")
    return trajectories | by_step | {name: trajectories[name][chosen] for name in names}


def _polygons(axes: Axes, colour: str) -> list[np.ndarray]:
    """Corners of polygons with a colour."""
    found = [patch for patch in axes.patches if isinstance(patch, Polygon)]
    return [
        patch.get_xy()[:-1]
        for patch in found
        if to_hex(patch.get_facecolor()).upper() == colour.upper()
    ]


def _boxes(axes: Axes) -> list[np.ndarray]:
    return _polygons(axes, style.OBSTACLE)


def _pillars(axes: Axes) -> list[tuple[float, float, float]]:
    found = [patch for patch in axes.patches if isinstance(patch, Circle)]
    return [(*patch.center, patch.radius) for patch in found]


def _overlaps(figure: Figure) -> list[str]:
    """Panels with their labels, title and legend that leave the page or overlap."""
    figure.canvas.draw()
    (title,) = [item for item in figure.texts if item.get_text() == figure.get_suptitle()]
    parts = {"title": title.get_window_extent()}
    parts["legend"] = figure.legends[0].get_window_extent()
    for number, axes in enumerate(figure.axes):
        if axes.get_visible():
            parts[f"panel {number}"] = axes.get_tightbbox()
    page = figure.bbox.padded(0.5)
    wrong = [name for name, box in parts.items() if not _holds(page, box)]
    for (one, first), (other, second) in itertools.combinations(parts.items(), 2):
        if first.overlaps(second):
            wrong.append(f"{one} on {other}")
    return wrong


def _holds(outer: BboxBase, inner: BboxBase) -> bool:
    return outer.x0 <= inner.x0 < inner.x1 <= outer.x1 and (
        outer.y0 <= inner.y0 < inner.y1 <= outer.y1
    )


def test_vessels_show_where_they_are_heading(trajectories: dict[str, np.ndarray]) -> None:
    trajectories["heading"][:, 0] = np.pi  # it goes astern
    axes = make_trajectories(trajectories).axes[0]

    marks = [item for item in axes.collections if isinstance(item, PolyCollection)]
    outlines = [path.vertices[:4] for item in marks for path in item.get_paths()]
    # 4 m, 2 m and 1.4 m of way with a mark every 1.6 m, the first after 0.8 m.
    assert len(outlines) == 2 + 1 + 1
    astern, ahead = outlines[0], outlines[2]
    assert astern[0, 0] < astern[1, 0]
    assert ahead[0, 0] > ahead[1, 0]


def test_of_many_vessels_few_are_drawn_and_all_are_counted(
    trajectories: dict[str, np.ndarray],
) -> None:
    steps = trajectories["steps"]
    for name in ("position", "heading", "action"):
        trajectories[name] = np.concatenate(10 * [trajectories[name]], axis=1)
    for name in ("goal", "outcome", "steps", "episode_seed"):
        trajectories[name] = np.concatenate(10 * [trajectories[name]])
    assert len(trajectories["steps"]) == 10 * len(steps)
    figure = make_trajectories(trajectories)
    paths = [c for c in figure.axes[0].collections if isinstance(c, LineCollection)]
    assert sum(len(item.get_segments()) for item in paths) == 16
    title = figure.get_suptitle().splitlines()[0]
    said = "The first 16 of 30 episodes from above (of all: 20 success, 10 timeout)"
    assert title == said
