"""Where a run is, what it was made with, and whether what is here may go on with it."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import logging
import platform
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gdrl_tasks
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.files.directory import RunDirectory
from gdrl_torchrl.files.errors import RunDirectoryError

_logger = logging.getLogger(__name__)

RUN_VERSION = 4
"""Version of what runs compute and of the state that they go on from.

Raised whenever a change of the code makes ``params_sha256`` of any experiment another one,
or checkpoints of before unusable: ``tests/runs/test_results_version.py`` notices.
"""
_PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "dm_control", "numpy", "numba")
"""What numbers depend on."""
_ROOTS = {
    "gdrl_torchrl": Path(__file__).parents[1],
    "gdrl_tasks": Path(gdrl_tasks.__file__).parent,
}


def provenance() -> dict[str, Any]:
    """Versions of the code and of what it runs on.

    Examples:
        >>> sorted(provenance())
        ['code', 'git', 'machine', 'packages', 'python', 'version']
    """
    return {
        "version": RUN_VERSION,
        "code": code_version(),
        "git": git_revision(_ROOTS["gdrl_torchrl"]),
        "python": platform.python_version(),
        "machine": platform.machine(),
        "packages": {name: _version(name) for name in _PACKAGES},
    }


def differing_packages(then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Packages whose versions differ between two provenances, in words.

    Examples:
        >>> then = {"packages": {"torch": "2.13.0", "numpy": "2.4.6"}}
        >>> differing_packages(then, {"packages": {"torch": "2.14.1", "numpy": "2.4.6"}})
        ['torch 2.13.0 (now 2.14.1)']
    """
    before = then.get("packages", {})
    return [
        f"{name} {before[name]} (now {version})"
        for name, version in now["packages"].items()
        if before.get(name, version) != version
    ]


@functools.cache
def code_version() -> str:
    """Version of the package and a digest of its sources, installed or not."""
    digest = hashlib.sha256()
    for name, root in _ROOTS.items():
        for source in sorted(root.rglob("*.py")):
            path = source.relative_to(root)
            digest.update(f"{name}/{path.as_posix()}".encode())
            digest.update(source.read_bytes())
    return f"{_version('gdrl_torchrl')}+{digest.hexdigest()[:8]}"


def git_revision(package: Path) -> str | None:
    """The commit that a package's files are of; None where git does not track them.

    Args:
        package: Folder of the package.
    """
    file = "__init__.py"
    # A repository may lie above an environment that the package is installed in.
    if _git(package, "ls-files", "--error-unmatch", file) is None:
        return None
    return _git(package, "describe", "--always", "--dirty", "--abbrev=12")


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        result = subprocess.run(
            ["git", *arguments],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip() or None


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


_NOT_IN_KEY = (
    "name",
    "seed",
    "runs_dir",
    "force",
    "toy",
    "budget",
    "evaluation",
    "checkpoint",
    "logger",
    "simulation",
    "faults",
)
"""What does not change what is learned, or may change between two starts of a run."""


def run_key(config: ExperimentConfig) -> str:
    """Eight hexadecimal digits of everything that shapes what is learned.

    Seed, budgets, reporting, places and threads are left out.
    """
    content = {
        name: value
        for name, value in dataclasses.asdict(config).items()
        if name not in _NOT_IN_KEY
    }
    # Options of the evolution do not matter when there is none.
    if not content["evolution"]["enabled"]:
        content["evolution"] = {"enabled": False}
    # A run that has kept no policies cannot go on as one that keeps some.
    if config.evaluation.num_policies:
        content["num_policies"] = config.evaluation.num_policies
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def directory_of(config: ExperimentConfig) -> RunDirectory:
    """The directory that belongs to a configuration; nothing is created."""
    parts = (config.name, run_key(config), f"seed_{config.seed}")
    return RunDirectory(Path(config.runs_dir).joinpath(*parts))


def open_directory(
    directory: RunDirectory, config: ExperimentConfig, overrides: Sequence[str] = ()
) -> None:
    """Create a directory, or check that it may go on.

    Packages that numbers depend on and that have changed are named in a warning.

    Args:
        directory: The directory.
        config: The configuration.
        overrides: What was given on the command line; kept beside it.

    Raises:
        RunDirectoryError: If it is of another version of runs and ``force`` is not set.
    """
    path = directory.path
    path.mkdir(parents=True, exist_ok=True)
    directory.clean()
    known, here = directory.read_json("provenance.json"), provenance()
    before: list[Any] = []
    if known is not None:
        _check_version(path, known, force=config.force)
        if differing := differing_packages(known, here):
            _logger.warning(
                "%s was written with %s: its numbers may differ from here on from those "
                "of a run of one version",
                path,
                ", ".join(differing),
            )
        before = known.pop("before", [])
        if known != here:
            before = [*before, known]
    directory.write_json("provenance.json", here | {"before": before})
    directory.write_json("config.json", dataclasses.asdict(config))
    directory.write_json("overrides.json", {"overrides": list(overrides)})


def _check_version(path: Path, found: Mapping[str, Any], *, force: bool) -> None:
    """Raise RunDirectoryError if a file of a run is of another version of runs."""
    version = found.get("version", 0)
    if version != RUN_VERSION and not force:
        raise RunDirectoryError(
            f"{path} was written by version {version} of runs, this is version "
            f"{RUN_VERSION}, whose results or files differ: pass force=true to go on "
            "with it all the same, or remove the directory to start anew"
        )
