"""Frames drawn from above: position, heading and captions are where they belong."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from gdrl_torchrl.pictures import style
from gdrl_torchrl.pictures.captions import Captions, caption_height
from gdrl_torchrl.pictures.from_above import FromAbove
from gdrl_torchrl.pictures.layout import Layout

AROUND = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
LAYOUT = Layout(
    half_extent_m=np.array([4.5, 4.5]),
    places=np.array(
        [
            [4.6, 0.0, 1.0, 0.0],
            [-2.0, 2.0, np.cos(0.25 * np.pi), np.sin(0.25 * np.pi)],
            [2.0, -3.0, 1.0, 0.0],
        ]
    ),
    is_box=np.array([True, True, False]),
    half_size_m=np.array([[0.1, 4.7], [1.5, 0.3], [0.8, 0.8]]),
    outline_m=0.5 * np.stack([np.cos(AROUND), np.sin(AROUND)], axis=-1),
)
"""A wall at the right, a slanted box, a pillar and a large round robot."""
SETTINGS = {"sea": {}, "arena": {"layout": LAYOUT}}


def _draw(
    position: tuple[float, float],
    heading: float,
    ranges: np.ndarray | None = None,
    **options: object,
) -> np.ndarray:
    view = FromAbove(
        goal=np.array([-4.0, -3.0]),
        tolerance_m=0.3,
        reach_m=5.0,
        wave_height_m=0.1,
        height=120,
        width=160,
        **({"surface": None} | options),
    )
    return view.draw(np.array([[0.0, 0.0], position]), heading, 1.0, ranges)


def _at(frame: np.ndarray, x: float, y: float) -> np.ndarray:
    """Colour of a place in the left panel, whose half height is 5 m."""
    return frame[round(60 - 12 * y), round(80 + 12 * x)].astype(int)


def _vehicle(frame: np.ndarray) -> np.ndarray:
    """Pixels of the hull, (row, column), ``[N, 2]``."""
    red, green, blue = frame.astype(int).transpose(2, 0, 1)
    yellow = np.argwhere((red > 200) & (green > 150) & (blue < 90))
    dark = np.argwhere(frame.max(axis=2) < 70)
    # Its bow; the scale is dark as well, and elsewhere.
    away = np.hypot(*(dark - yellow.mean(axis=0)).T)
    span = np.hypot(*(yellow - yellow.mean(axis=0)).T).max()
    return np.concatenate([yellow, dark[away < 2.0 * span]])


def test_frame_is_two_panels_of_the_size_asked_for() -> None:
    frame = _draw((0.0, 0.0), 0.0)

    assert frame.shape == (120, 320, 3)
    assert frame.dtype == np.uint8


@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize(("x", "y"), [(3.0, 2.0), (-3.0, -2.0), (3.0, -2.0)])
def test_x_is_to_the_right_and_y_is_up(setting: str, x: float, y: float) -> None:
    frame = _draw((x, y), 0.0, **SETTINGS[setting])
    row, column = _vehicle(frame[:, :160]).mean(axis=0)

    # Half the panel's height is 5 m, its middle is the origin.
    assert column == pytest.approx(80 + 12 * x, abs=2)
    assert row == pytest.approx(60 - 12 * y, abs=2)


@pytest.mark.parametrize("heading", [0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi])
def test_bow_points_along_the_heading(heading: float) -> None:
    pixels = _vehicle(_draw((1.0, 1.0), heading)[:, 160:])
    offset = (pixels - pixels.mean(axis=0))[:, ::-1] * [1.0, -1.0]

    along = offset @ [np.cos(heading), np.sin(heading)]
    across = np.abs(offset @ [-np.sin(heading), np.cos(heading)])
    reach = np.abs(along).max()
    assert across[along > 0.6 * reach].max() < 0.8 * across[along < -0.6 * reach].max()


@pytest.mark.parametrize("heading", [0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi])
def test_bow_of_a_boat_is_dark_and_its_stern_is_not(heading: float) -> None:
    close = _draw((1.0, 1.0), heading)[:, 160:]

    # The panel's half height is 2 m, its middle is the boat.
    ahead = np.array([np.cos(heading), -np.sin(heading)])
    column, row = np.round([80, 60] + 12 * ahead).astype(int)
    assert close[row, column].max() < 90
    column, row = np.round([80, 60] - 12 * ahead).astype(int)
    assert close[row, column].min() < 90 < 200 < close[row, column].max()


@pytest.mark.parametrize(
    ("position", "row", "column"),
    [((-4.0, 0.0), 112, 80), ((-4.0, -6.0), 8, 80), ((4.0, -3.0), 60, 8)],
)
def test_a_goal_out_of_view_is_pointed_at_from_the_edge(
    position: tuple[float, float], row: int, column: int
) -> None:
    def reddish(picture: np.ndarray) -> np.ndarray:
        red, green, blue = picture.astype(int).transpose(2, 0, 1)
        return np.argwhere((red > 180) & (green < 130) & (blue < 60))

    far = reddish(_draw(position, 0.0)[:, 164:])
    assert len(far) > 5
    np.testing.assert_allclose(far.mean(axis=0), [row, column - 4], atol=6)
    # In view there is the goal itself: its ring and its cross, in the middle.
    near = reddish(_draw((-4.0, -2.5), 0.0)[:, 164:])
    np.testing.assert_allclose(near.mean(axis=0), [75, 76], atol=2)


@pytest.mark.parametrize("heading", [0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi])
def test_round_robot_shows_where_it_is_heading(heading: float) -> None:
    close = _draw((1.0, 1.0), heading, **SETTINGS["arena"])[:, 160:]

    # The panel's half height is 1.2 m, its middle is the robot.
    ahead = np.array([np.cos(heading), -np.sin(heading)])
    column, row = np.round([80, 60] + 15 * ahead).astype(int)
    assert close[row, column].max() < 90
    for turn in (0.5 * np.pi, np.pi, -0.5 * np.pi):
        aside = [np.cos(heading + turn), -np.sin(heading + turn)]
        column, row = np.round([80, 60] + 15 * np.array(aside)).astype(int)
        assert close[row, column].min() < 90 < 200 < close[row, column].max()


def test_obstacles_stand_where_they_are_instead_of_a_sea() -> None:
    sea, arena = (_draw((0.0, -1.0), 0.0, **SETTINGS[name]) for name in SETTINGS)

    inside = [(-2.0, 2.0), (-1.2, 2.8), (-2.8, 1.2), (2.0, -3.0), (2.4, -2.7)]
    for x, y in inside:
        np.testing.assert_allclose(_at(arena, x, y), _rgb(style.OBSTACLE), atol=2)
    # Beside the slanted box, and where it would stand if it were slanted otherwise.
    for x, y in [(-1.2, 1.2), (-2.8, 2.8), (2.0, -1.8), (0.0, 3.0)]:
        np.testing.assert_allclose(_at(arena, x, y), _rgb(style.FLOOR), atol=2)
    np.testing.assert_allclose(_at(arena, 4.6, 1.0), _rgb(style.WALL), atol=2)
    np.testing.assert_allclose(_at(arena, 5.5, 1.0), _rgb(style.OUTSIDE), atol=2)
    np.testing.assert_allclose(_at(sea, 0.0, 3.0), _rgb(style.STILL_WATER), atol=2)


def test_beams_end_at_what_the_lidar_reports() -> None:
    angles = np.array([-0.5 * np.pi, 0.0, 0.5 * np.pi])
    ranges = np.array([1.5, 3.0, 2.0])
    options = SETTINGS["arena"] | {"beam_angles": angles}
    without = _draw((0.0, 0.0), 0.5 * np.pi, **options)

    frame = _draw((0.0, 0.0), 0.5 * np.pi, ranges, **options)

    rows, columns = np.nonzero((frame != without).any(axis=-1)[:, :160])
    # Heading up, the first beam is to the right and the last to the left.
    assert columns.max() == pytest.approx(80 + 12 * 1.5, abs=1)
    assert columns.min() == pytest.approx(80 - 12 * 2.0, abs=1)
    assert rows.min() == pytest.approx(60 - 12 * 3.0, abs=1)
    assert rows.max() == pytest.approx(60, abs=1)


def test_sea_is_asked_for_at_the_places_and_time_that_are_shown() -> None:
    asked = []

    def surface(x: np.ndarray, y: np.ndarray, time_s: float) -> np.ndarray:
        asked.append((x.mean(), y.mean(), np.ptp(x), time_s))
        return np.zeros((len(y), len(x)))

    _draw((2.0, 1.0), 0.0, surface=surface)

    (left, right) = asked
    assert left == pytest.approx((0.0, 0.0, 2 * 20 / 3, 1.0), abs=0.1)
    assert right == pytest.approx((2.0, 1.0, 2 * 8 / 3, 1.0), abs=0.1)


def test_crests_are_light_where_they_are() -> None:
    frame = _draw((-2.0, -2.0), 0.0, surface=lambda x, y, _: 0.01 * (x + 3.0 * y[:, None]))

    light = frame[:, :160].mean(axis=2)
    assert light[20, 40] > light[100, 40] + 5
    assert light[20, 140] > light[20, 20] + 2


@pytest.mark.parametrize("recorded", ["trajectories", "arena_trajectories"])
def test_captions_fit_every_task(recorded: str, request: pytest.FixtureRequest) -> None:
    trajectories = request.getfixturevalue(recorded)
    captions = Captions(trajectories, 2.0, 320)

    distance = np.hypot(*trajectories["goal"][2])
    texts = ("Episode 3 of 3", "0.00 s", f"{distance:.2f} m to the goal", "running")
    assert captions.text(2, 0) == texts


def test_caption_says_episode_time_distance_and_outcome(
    trajectories: dict[str, np.ndarray],
) -> None:
    captions = Captions(trajectories, 2.0, 320)

    assert captions.text(0, 1) == (
        "Episode 1 of 3",
        "0.25 s",
        "3.00 m to the goal",
        "running",
    )
    assert captions.text(0, 4)[2:] == ("0.00 m to the goal", "success")
    assert captions.text(2, 6)[3] == "timeout"


def test_caption_leaves_the_frame_as_it_is(trajectories: dict[str, np.ndarray]) -> None:
    frame = np.full((40, 320, 3), 200, np.uint8)

    captioned = Captions(trajectories, 2.0, 320).under(frame, 0, 0)

    assert captioned.shape == (40 + caption_height(320), 320, 3)
    np.testing.assert_array_equal(captioned[:40], frame)
    assert captioned[40:].max() > 150
    assert captioned[40:].min() < 60


def _rgb(colour: str) -> np.ndarray:
    return 255.0 * np.array(to_rgb(colour))
