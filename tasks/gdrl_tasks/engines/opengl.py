"""Preparations before dm_control, and with it OpenGL, is imported."""

from __future__ import annotations

import contextlib
import ctypes
import ctypes.util
import importlib.util
import os
import sys
from pathlib import Path

_OF_MESA = ("libLLVM", "libOSMesa", "libgallium", "_dri.so")
"""Parts of the names of Mesa's libraries that carry, or load, an LLVM."""


def prepare_opengl() -> None:
    """Make OpenGL and Triton live in one process, and choose a backend that can work.

    Call it before dm_control is imported; later calls do no harm.
    """
    load_triton()
    # Without a display dm_control would still choose GLFW, whose first frame then fails.
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        if "MUJOCO_GL" not in os.environ and ctypes.util.find_library("EGL"):
            os.environ["MUJOCO_GL"] = "egl"


def load_triton() -> None:
    """Load Triton's library, which tensordict loads too, apart from that of Mesa.

    Mesa's software driver and Triton each carry an LLVM. If Mesa's is in the process
    already, Triton's would use its symbols, and a segmentation fault would end the
    process. So Triton's library is then loaded here, with symbols of its own; later
    imports of Triton get this library. This needs no torch; without Triton nothing
    happens.

    It cannot help a process that imports Triton, or tensordict, after OpenGL and before
    ``gdrl_tasks`` has loaded an environment or ``gdrl_torchrl`` was imported.
    """
    if "triton" in sys.modules:
        return
    triton = importlib.util.find_spec("triton")
    if triton is None or triton.origin is None:
        return
    mode = ctypes.DEFAULT_MODE
    # Only if needed: symbols of its own do not go together with a replaced malloc.
    if _mesa_is_loaded():
        mode |= getattr(os, "RTLD_DEEPBIND", 0)
    with contextlib.suppress(OSError):
        ctypes.CDLL(str(Path(triton.origin).with_name("_C") / "libtriton.so"), mode=mode)


def _mesa_is_loaded() -> bool:
    try:
        mapped = Path("/proc/self/maps").read_text()
    except OSError:  # not Linux
        return False
    return any(name in mapped for name in _OF_MESA)
