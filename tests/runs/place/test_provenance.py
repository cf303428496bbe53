"""What a run was made with: one code in a checkout and a wheel, and no other's commit."""

from __future__ import annotations

import shutil
import subprocess

import pytest

import gdrl_tasks
import gdrl_torchrl
from gdrl_torchrl.runs import place as provenance
from gdrl_torchrl.runs.place import code_version, git_revision


def git(folder, *arguments):
    who = ("-c", "user.name=a", "-c", "user.email=a@b")
    subprocess.run(["git", *who, *arguments], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def package(tmp_path):
    """A package within a folder that could be a repository."""
    path = tmp_path / "env" / "package"
    path.mkdir(parents=True)
    (path / "__init__.py").touch()
    return path


@pytest.fixture
def digest_of(monkeypatch):
    def digest(roots):
        monkeypatch.setattr(provenance, "_ROOTS", roots)
        code_version.cache_clear()
        return code_version()

    yield digest
    monkeypatch.undo()
    code_version.cache_clear()


def test_a_wheel_and_a_checkout_of_equal_sources_are_one_code(digest_of, tmp_path):
    roots = dict(provenance._ROOTS)
    here = digest_of(roots)
    # As in a wheel, with byte code beside.
    for name, module in (("gdrl_torchrl", gdrl_torchrl), ("gdrl_tasks", gdrl_tasks)):
        (source,) = module.__path__
        shutil.copytree(source, tmp_path / name, dirs_exist_ok=True)
    installed = {name: tmp_path / name for name in roots}
    assert digest_of(installed) == here
    (tmp_path / "gdrl_torchrl" / "keys.py").write_text("# another\n")
    assert digest_of(installed) != here


def test_the_commit_is_that_of_the_packages_own_files(package):
    assert git_revision(package) is None, "no repository"
    git(package, "init", "--quiet")
    (package / "__init__.py").write_text("x = 1\n")
    git(package, "add", ".")
    git(package, "commit", "--quiet", "-m", "one")
    found = git_revision(package)
    assert found is not None
    assert len(found) == 12
    (package / "__init__.py").write_text("x = 2\n")
    assert git_revision(package) == f"{found}-dirty"


def test_a_repository_above_an_environment_is_not_the_packages(package):
    above = package.parents[1]
    git(above, "init", "--quiet")
    (above / "thesis.tex").touch()
    git(above, "add", "thesis.tex")
    git(above, "commit", "--quiet", "-m", "mine")
    assert git_revision(package) is None
