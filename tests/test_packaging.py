"""The package as it is installed: its wheel, its versions."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def run(*command: str | Path, cwd: Path, **env: str) -> str:
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    result = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=clean | env,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def constraints() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in pins}


def requirements(*extras: str) -> list[Requirement]:
    lines = list(PROJECT["project"]["dependencies"])
    for extra in extras:
        lines += PROJECT["project"]["optional-dependencies"][extra]
    return [Requirement(line) for line in lines]


def test_constraints_have_one_exact_version_per_line():
    text = (ROOT / "constraints.txt").read_text()
    for line in text.splitlines():
        assert re.fullmatch(r"#.*|[a-z0-9-]+==[0-9][0-9a-z.]*", line), line
    assert len(constraints()) == sum(not line.startswith("#") for line in text.splitlines())


def test_constraints_satisfy_the_ranges():
    pins = constraints()
    for requirement in [*requirements("test", "dev"), Requirement("setuptools>=77")]:
        version = pins[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), f"{requirement} against {version}"
    assert pins["torch"] == "2.14.1"
    assert pins["torchrl"] == "0.14.1"


def test_constraints_pin_all_that_is_installed_for_us():
    pins = constraints()
    todo = requirements("test", "dev")
    seen: set[str] = set()
    while todo:
        requirement = todo.pop()
        name = canonicalize_name(requirement.name)
        key = str(Requirement(f"{name}[{','.join(sorted(requirement.extras))}]"))
        if key in seen:
            continue
        seen.add(key)
        assert name in pins, f"{requirement} is not in constraints.txt"
        try:
            needs = metadata.requires(name) or []
        except metadata.PackageNotFoundError:  # a tool that this machine lacks
            continue
        for need in map(Requirement, needs):
            environments = [{"extra": extra} for extra in ("", *requirement.extras)]
            if need.marker is None or any(map(need.marker.evaluate, environments)):
                todo.append(need)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Built from a copy, so that neither build folders nor ignored files take part.
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in ("tasks", "gdrl_torchrl"):
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    options = (
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
        "--wheel-dir",
        source / "dist",
    )
    run(sys.executable, "-m", "pip", "wheel", "--quiet", *options, source, cwd=source)
    return next((source / "dist").glob("*.whl"))


@pytest.fixture(scope="module")
def venv(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel, beside the dependencies of this one."""
    folder = tmp_path_factory.mktemp("venv")
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder)
    python = folder / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "--quiet")
    run(*pip, "--no-deps", "--no-index", "--no-compile", wheel, cwd=folder)
    # After the installation, so that pip sees no other gdrl_torchrl to replace. A folder
    # named in a .pth file comes last, and the .pth files in it (those of an editable
    # installation) are not read.
    paths = sysconfig.get_paths(vars={"base": folder, "platbase": folder})
    others = [path for path in sys.path if path.endswith("-packages")]
    (Path(paths["purelib"]) / "dependencies.pth").write_text("\n".join(others))
    return folder


def test_wheel_has_all_files_and_no_others(wheel: Path):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {
        "gdrl_tasks",
        "gdrl_torchrl",
    }
    assert {"gdrl_tasks/py.typed", "gdrl_torchrl/py.typed"} <= names
    patterns = ("gdrl_torchrl/**/*.py", "gdrl_torchrl/**/*.yaml", "tasks/**/*.py")
    files = [file.relative_to(ROOT) for pattern in patterns for file in ROOT.glob(pattern)]
    assert {file.as_posix().removeprefix("tasks/") for file in files} <= names


@pytest.mark.slow
def test_wheel_works_without_the_tree(venv: Path, tmp_path: Path):
    where = "import gdrl_tasks as a, gdrl_torchrl as b; print(a.__file__, b.__file__)"
    files = run(venv / "bin" / "python", "-c", where, cwd=tmp_path).split()
    assert all(Path(file).is_relative_to(venv) for file in files), files
    config = run(venv / "bin" / "gdrl-train", "--cfg", "job", cwd=tmp_path)
    assert "seed:" in config
    assert "task:" in config
    assert list(tmp_path.iterdir()) == []


def test_the_simulation_half_imports_neither_torch_nor_hydra(tmp_path: Path):
    code = """
import sys
import gdrl_tasks
loaded = {name.partition(".")[0] for name in sys.modules}
print(*sorted(loaded & {"torch", "torchrl", "tensordict", "hydra", "omegaconf"}))
"""
    path = str(ROOT / "tasks")
    loaded = run(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=path)
    assert loaded.split() == []


@pytest.mark.full
def test_torchrl_extension_fits_torch(tmp_path: Path):
    code = """
import torch
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler

sampler = PrioritizedSampler(max_capacity=8, alpha=0.7, beta=0.5)
buffer = ReplayBuffer(storage=LazyTensorStorage(8), sampler=sampler, batch_size=4)
buffer.extend(torch.arange(8))
buffer.update_priority(torch.arange(8), torch.tensor([0.0] * 7 + [1e6]))
print(int((buffer.sample() == 7).sum()))
"""
    errors = (
        "-Werror:Failed to import torchrl C++ binaries",
        "-Werror:torchrl C++ extension is not available",
    )
    output = run(sys.executable, *errors, "-c", code, cwd=tmp_path, RL_WARNINGS="1")
    assert output.splitlines()[-1] == "4"  # TorchRL logs to standard output too
