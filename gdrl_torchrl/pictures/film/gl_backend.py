"""Whether this machine can render, found out without risking this process."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tempfile

_PROBE_LIMIT_S = 60.0
_PROBE = """
from dm_control import mujoco
physics = mujoco.Physics.from_xml_string("<mujoco/>")
physics.render(8, 8)
physics.free()
"""
_SWITCHED_OFF = ("off", "disable", "disabled", "false", "0")


def find_gl_backend() -> tuple[str | None, str]:
    """Find an OpenGL backend that renders, trying each in a process of its own.

    ``MUJOCO_GL`` is read when dm_control is imported, and a failed choice cannot be
    taken back: so this process should import dm_control only after another one has
    rendered. A choice that was made already, by the user or by an import, is kept.

    Returns:
        Value for ``MUJOCO_GL``, or None, and then the reason why none works.
    """
    reasons = []
    for candidate in _candidates():
        problem = problem_with(candidate)
        if problem is None:
            return candidate, ""
        reasons.append(f"MUJOCO_GL={candidate}: {problem}")
    return None, "; ".join(reasons)


def _candidates() -> tuple[str, ...]:
    loaded = sys.modules.get("dm_control._render")
    if loaded is not None:
        return (getattr(loaded, "BACKEND", None) or "disable",)
    if "MUJOCO_GL" in os.environ:
        return (os.environ["MUJOCO_GL"],)
    if not sys.platform.startswith("linux"):
        return ("glfw",)
    # Without a display, GLFW would be chosen by dm_control and fail at the first frame.
    return ("egl", "glfw", "osmesa") if os.environ.get("DISPLAY") else ("egl", "osmesa")


@functools.cache
def problem_with(backend: str) -> str | None:
    """Why dm_control cannot render with a backend, or None if it can."""
    if backend in _SWITCHED_OFF:
        return "rendering is switched off"
    with tempfile.TemporaryDirectory() as folder:
        try:
            done = subprocess.run(
                [sys.executable, "-c", _PROBE],
                env=os.environ | {"MUJOCO_GL": backend},
                cwd=folder,  # MuJoCo may leave a log there
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=_PROBE_LIMIT_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return str(error)
    if done.returncode == 0:
        return None
    lines = done.stderr.strip().splitlines()
    return lines[-1] if lines else f"exit status {done.returncode}"
