"""Frames drawn from above: position, heading and captions are where they belong."""

from __future__ import annotations

import numpy as np
import pytest

from gdrl_torchrl.analysis.captions import Captions, caption_height
from gdrl_torchrl.analysis.from_above import FromAbove


def _draw(position: tuple[float, float], heading: float, **options: object) -> np.ndarray:
    view = FromAbove(
        goal=np.array([-4.0, -3.0]),
        tolerance_m=0.3,
        reach_m=5.0,
        wave_height_m=0.1,
        height=120,
        width=160,
        **({"surface": None} | options),
    )
    return view.draw(np.array([[0.0, 0.0], position]), heading, 1.0)


def _boat(frame: np.ndarray) -> np.ndarray:
    """Pixels of the hull, (row, column), ``[N, 2]``."""
    red, green, blue = frame.astype(int).transpose(2, 0, 1)
    return np.argwhere((red > 200) & (green > 150) & (blue < 90))


def test_frame_is_two_panels_of_the_size_asked_for() -> None:
    frame = _draw((0.0, 0.0), 0.0)

    assert frame.shape == (120, 320, 3)
    assert frame.dtype == np.uint8


@pytest.mark.parametrize(("x", "y"), [(3.0, 2.0), (-3.0, -2.0), (3.0, -2.0)])
def test_x_is_to_the_right_and_y_is_up(x: float, y: float) -> None:
    row, column = _boat(_draw((x, y), 0.0)[:, :160]).mean(axis=0)

    # Half the panel's height is 5 m, its middle is the origin.
    assert column == pytest.approx(80 + 12 * x, abs=2)
    assert row == pytest.approx(60 - 12 * y, abs=2)


@pytest.mark.parametrize("heading", [0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi])
def test_bow_points_along_the_heading(heading: float) -> None:
    pixels = _boat(_draw((1.0, 1.0), heading)[:, 160:])
    offset = (pixels - pixels.mean(axis=0))[:, ::-1] * [1.0, -1.0]

    along = offset @ [np.cos(heading), np.sin(heading)]
    across = np.abs(offset @ [-np.sin(heading), np.cos(heading)])
    reach = np.abs(along).max()
    assert across[along > 0.6 * reach].max() < 0.8 * across[along < -0.6 * reach].max()


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
