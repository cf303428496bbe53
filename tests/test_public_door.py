"""What the package offers by name, and what importing it costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import gdrl_torchrl


def test_every_name_of_the_api_is_there_and_documented():
    assert set(gdrl_torchrl.__all__) <= set(dir(gdrl_torchrl))
    for name in gdrl_torchrl.__all__:
        thing = getattr(gdrl_torchrl, name)
        assert thing.__name__ == name
        assert thing.__doc__, name


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(gdrl_torchrl.__file__).read_text())
    (block,) = [
        node for node in tree.body if isinstance(node, ast.If) and len(node.body) > 5
    ]
    names = [alias.name for node in block.body for alias in node.names]
    assert sorted(names) == sorted(gdrl_torchrl.__all__)


def test_other_names_are_refused():
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        gdrl_torchrl.nonsense  # noqa: B018


def test_importing_the_package_imports_neither_torch_nor_mujoco():
    code = """
import sys
import gdrl_torchrl
loaded = {name.partition(".")[0] for name in sys.modules}
print(*sorted(loaded & {"torch", "torchrl", "tensordict", "hydra", "mujoco", "numba"}))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == []
