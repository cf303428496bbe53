"""Settings of all tests, those in docstrings included."""

from __future__ import annotations

import os
import subprocess
import sys

import hypothesis
import pytest

# Fixtures of folders that are not one below the other.
pytest_plugins = ["tests.recorded"]


def _egl_works() -> bool:
    # Tried in another process: a process cannot take a failed choice of backend back.
    command = [sys.executable, "-c", "import mujoco.egl"]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


# Before anything imports MuJoCo. The workers of pytest-xdist inherit the choice.
if "MUJOCO_GL" not in os.environ:
    os.environ["MUJOCO_GL"] = "egl" if _egl_works() else "disable"
os.environ.setdefault("MPLBACKEND", "Agg")

hypothesis.settings.register_profile("default", deadline=None, derandomize=True)
hypothesis.settings.load_profile("default")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("numprocesses", None) and not hasattr(config, "workerinput"):
        # It starts the processes that run tests, and runs none itself.
        return
    # tensordict loads Triton. Loaded after Mesa's software driver, whose LLVM differs
    # from its own, Triton ends the process with a segmentation fault.
    import tensordict  # noqa: F401
    import torch

    torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if os.environ["MUJOCO_GL"] == "disable":
        skip = pytest.mark.skip(reason="no OpenGL backend")
        for item in items:
            if item.get_closest_marker("render"):
                item.add_marker(skip)
