"""A bar with episode, time, distance and outcome under the frames of a video."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gdrl_torchrl.pictures import style

_BACKGROUND = "#1d2a33"
_TEXT = "#f2f5f7"
_FAINT = "#9fb0bb"
# The figures' colours, lighter: they stand on a dark bar.
_OUTCOME_COLOURS = style.OUTCOME_COLOURS | {
    "success": "#35d0a0",
    "timeout": "#ff8a3d",
    "collision": "#e8a3c8",
    "capsized": "#6db8ea",
    "diverged": "#ffffff",
    "running": _FAINT,
}


class Captions:
    """Captions of recorded episodes.

    Args:
        trajectories: Arrays of
            :func:`gdrl_torchrl.pictures.film.episodes.record_trajectories`.
        speed: Simulated seconds per second of the video.
        width: Width of the frames, pixels.
    """

    def __init__(
        self, trajectories: dict[str, np.ndarray], speed: float, width: int
    ) -> None:
        self.trajectories = trajectories
        self.speed = speed
        self.height = caption_height(width)
        fonts = Path(matplotlib.get_data_path(), "fonts", "ttf")
        size = max(7, round(0.44 * self.height))
        self._font = ImageFont.truetype(fonts / "DejaVuSans.ttf", size)
        self._bold = ImageFont.truetype(fonts / "DejaVuSans-Bold.ttf", size)

    def text(self, episode: int, step: float) -> tuple[str, str, str, str]:
        """Episode, time, distance to the goal, and how the episode stands."""
        data = self.trajectories
        time_s = step * float(data["control_interval_s"])
        before = min(int(step), len(data["position"]) - 1)
        position = data["position"][before, episode]
        if step > before:
            after = data["position"][before + 1, episode]
            position = position + (step - before) * (after - position)
        distance_m = float(np.hypot(*(data["goal"][episode] - position)))
        ended = step >= data["steps"][episode]
        outcome = data["outcome_names"][data["outcome"][episode] if ended else 0]
        return (
            f"Episode {episode + 1} of {len(data['steps'])}",
            f"{time_s:.2f} s",
            f"{distance_m:.2f} m to the goal",
            str(outcome),
        )

    def under(self, frame: np.ndarray, episode: int, step: float) -> np.ndarray:
        """Put the caption of a control step under a frame.

        Args:
            frame: RGB image, uint8 ``[H, W, 3]``.
            episode: Number of the episode, from 0.
            step: Control steps since its start; also between two of them.

        Returns:
            RGB image, uint8 ``[H + caption_height(W), W, 3]``.
        """
        width = frame.shape[1]
        bar = Image.new("RGB", (width, self.height), _BACKGROUND)
        pen = ImageDraw.Draw(bar)
        title, time, distance, outcome = self.text(episode, step)
        middle = 0.5 * self.height

        def write(at: float, text: str, anchor: str, colour: str, font: object) -> None:
            pen.text((at * width, middle), text, colour, font, anchor)  # pyright: ignore

        write(0.02, title, "lm", _TEXT, self._bold)
        write(0.34, time, "rm", _TEXT, self._font)
        write(0.60, distance, "rm", _TEXT, self._font)
        colour = _OUTCOME_COLOURS.get(outcome, _FAINT)
        write(0.66, outcome, "lm", colour, self._bold)
        write(0.98, f"{self.speed:.3g}× real time", "rm", _FAINT, self._font)
        return np.concatenate([frame, np.asarray(bar)])


def caption_height(width: int) -> int:
    """Height of the bar under frames of a width, pixels; even, as H.264 asks.

    Examples:
        >>> caption_height(960)
        40
    """
    return max(12, 2 * round(width / 48))
