"""OpenGL, a task and Triton can come into a process in any order."""

import functools
import itertools
import os
import subprocess
import sys

import pytest

ORDERS = {
    "suite first": "from dm_control import suite; import gdrl_tasks; LOAD",
    "mujoco first": "from dm_control import mujoco; import gdrl_tasks; LOAD",
    "another task first": """
from dm_control import suite
other = suite.load("cartpole", "swingup")
other.reset()
FRAME(other)
import gdrl_tasks; LOAD
""",
    "task first": "import gdrl_tasks; LOAD; from dm_control import suite",
    "torch, then suite": "import torch; from dm_control import suite, mujoco; LOAD",
    "suite, then the learning half": "from dm_control import suite; import gdrl_torchrl; "
    "import tensordict; LOAD",
}
LOAD = """
import gdrl_tasks
environment = gdrl_tasks.load("water", random=0)
environment.reset()
"""
AFTERWARDS = """
FRAME(environment)
import gdrl_torchrl, tensordict, torch
assert tensordict.TensorDict(a=torch.ones(2))["a"].sum() == 2
environment.step([1.0, 1.0])
FRAME(environment)
print("reached the end")
"""
FRAME = "def FRAME(env): assert env.physics.render(16, 16, camera_id=0).std() > 0"
NO_FRAME = "def FRAME(env): pass"


def run(program, backend):
    # What this process has chosen, dm_control has left in the environment.
    inherited = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    return subprocess.run(
        [sys.executable, "-c", program],
        env=inherited | {"MUJOCO_GL": backend},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@functools.cache
def reason_not_to_use(backend):
    if backend == "disable":
        return None
    empty = "from dm_control import mujoco\n"
    empty += "mujoco.Physics.from_xml_string('<mujoco/>').render(8, 8)\nprint('drawn')"
    done = run(empty, backend)
    if "drawn" in done.stdout:
        return None
    return f"MUJOCO_GL={backend} does not render here: {done.stderr.strip()[-200:]}"


CASES = [
    *((order, "egl") for order in ORDERS),
    # Mesa's software driver without a screen, and none: the order that ends in torch, and
    # the one that begins with it.
    *itertools.product(("suite first", "torch, then suite"), ("osmesa", "disable")),
]
ALWAYS = [("suite first", "egl")]
"""What failed before; the others take more than a minute."""


@pytest.mark.parametrize(
    ("order", "backend"),
    [
        pytest.param(*case, marks=[pytest.mark.full] * (case not in ALWAYS))
        for case in CASES
    ],
)
def test_any_order_of_imports_loads_a_task_and_draws_it(order, backend):
    reason = reason_not_to_use(backend)
    if reason:
        pytest.skip(reason)
    program = ORDERS[order] + "\n" + AFTERWARDS
    program = program.replace("LOAD", LOAD.strip())
    program = (NO_FRAME if backend == "disable" else FRAME) + "\n" + program
    done = run(program, backend)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "reached the end" in done.stdout
