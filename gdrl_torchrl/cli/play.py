"""``gdrl-play run=<dir> task.sea=rough ...``: watch a run's policy in a window."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from typing import Any

from gdrl_torchrl.cli.shared.show_arguments import Arguments, number_in

_FPS = 25
_ARGUMENTS = Arguments(
    "gdrl-play",
    "Watch a trained policy in a window, on worlds that training never saw. Drag with the "
    "mouse to look around; [ and ] change the camera.",
    {
        "episodes=<number>": "Episodes, one after another; 10 if it is not given.",
        "camera=<name>": "chase, top or free; chase if it is not given.",
    },
    [
        "  gdrl-play run=runs/gppo_water/water/gppo/c5a88fc9/seed_0",
        "  gdrl-play run=<folder> episodes=3 camera=top task.sea=rough",
    ],
)
_CAMERAS = ("chase", "top", "free")


def play_run(values: dict[str, str], overrides: Sequence[str]) -> None:
    """Show the policy of a run until all episodes or the window have ended.

    Args:
        values: ``run`` and the other options by name, as texts.
        overrides: Other options of the task, ``option=value``.

    Raises:
        ValueError: If an option is not valid, a file of the run is missing or damaged, or
            there is no screen.
    """
    episodes = number_in(values, "episodes", 10, least=1, most=1000)
    camera = values.get("camera", "chase")
    if camera not in _CAMERAS:
        raise ValueError(f"camera={camera} must be one of {', '.join(_CAMERAS)}")
    _check_screen(values["run"])
    # These take seconds to import: arguments are checked before.
    from gdrl_torchrl.cli.shared.saved_policy import SavedPolicy

    policy = SavedPolicy.of(values["run"], overrides)
    from gdrl_torchrl.pictures.film.episodes import record_trajectories
    from gdrl_torchrl.pictures.film.frames import Film, replayed_moments
    from gdrl_torchrl.pictures.film.gl_backend import find_gl_backend

    # What paints the sea asks for one, beside the window.
    backend, _ = find_gl_backend()
    os.environ.setdefault("MUJOCO_GL", backend or "disable")
    trajectories = record_trajectories(policy.task, policy.load(), policy.seeds(episodes))
    size = {"height": 2, "width": 2}
    film = Film.of(trajectories, fps=_FPS, max_frames=sys.maxsize, **size)
    window: Any = None
    try:
        due = time.monotonic()
        for shown in replayed_moments(policy.task, film, prepare=lambda physics: None):
            if window is None:
                window = _Window(shown.physics, camera)
            if not window.shows(shown.physics):
                return
            due = max(due + 1.0 / _FPS, time.monotonic())
            time.sleep(due - time.monotonic() if due > time.monotonic() else 0.0)
    finally:
        if window is not None:
            window.close()


class _Window:
    """MuJoCo's viewer of a physics that something else moves."""

    def __init__(self, physics: Any, camera: str) -> None:
        import mujoco
        from mujoco.viewer import launch_passive

        from gdrl_tasks.engines.scenery import PAINTED

        model, data = physics.model.ptr, physics.data.ptr
        self._painted = [
            number
            for number in range(model.ntex)
            if model.texture(number).name.startswith(PAINTED)
        ]
        self._viewer = launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        if camera != "free":
            self._viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self._viewer.cam.fixedcamid = model.camera(camera).id

    def shows(self, physics: Any) -> bool:
        """Show it as it is now; False if the window was closed."""
        if not self._viewer.is_running():
            return False
        physics.before_render()
        for texture in self._painted:
            self._viewer.update_texture(texture)
        self._viewer.sync()
        return True

    def close(self) -> None:
        """Close the window."""
        self._viewer.close()


def _check_screen(run: str) -> None:
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise ValueError(
            "DISPLAY= must name a screen to open a window on: log in on one or by ssh -Y, "
            f"or make a film with gdrl-video run={run}"
        )


def main() -> None:
    """Entry point of ``gdrl-play``."""
    values, overrides = _ARGUMENTS.read()
    try:
        play_run(values, overrides)
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
