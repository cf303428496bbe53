"""Compiled functions where nothing can be kept on a disk."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

import gdrl_tasks
from gdrl_tasks import compiled as module
from gdrl_tasks.compiled import compiled

SOURCES = Path(gdrl_tasks.__file__).parent
PROGRAM = """
import gdrl_tasks, numpy
assert gdrl_tasks.__file__.startswith({folder!r}), gdrl_tasks.__file__
from gdrl_tasks import kernels
print(kernels.all_choices(numpy.array([0.0, 1.0]), 2))
"""


@pytest.fixture
def read_only_package(tmp_path):
    """A folder with the package, of which nothing but its files can be written."""
    package = tmp_path / "gdrl_tasks"
    for source in SOURCES.rglob("*.py"):
        copy = package / source.relative_to(SOURCES)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(source.read_bytes())
        # What nobody can make a folder of, not even who may write to anything.
        (copy.parent / "__pycache__").touch()
    return tmp_path


def run(folder, **environment):
    program = PROGRAM.format(folder=str(folder))
    cleared = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "XDG"))}
    return subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(folder)!r}){program}"],
        env=cleared | {"HOME": "/dev/null", "PYTHONDONTWRITEBYTECODE": "1"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_package_that_cannot_be_written_to_works_without_a_home_and_says_so_once(
    read_only_package,
):
    done = run(read_only_package)
    assert done.stdout == "True\n", done.stderr
    (line,) = done.stderr.splitlines()
    assert "NUMBA_CACHE_DIR" in line


@pytest.mark.full
def test_what_is_advised_helps(read_only_package, tmp_path):
    done = run(read_only_package, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert (done.stdout, done.stderr) == ("True\n", "")
    assert list((tmp_path / "cache").rglob("*all_choices*.nbi"))


@pytest.mark.parametrize("part", ["save", "load"])
def test_a_full_disk_does_not_stop_who_calculates(part, monkeypatch, caplog):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    # Nothing is kept yet, and nothing stays for the next run of this test.
    for method in ("save", "load"):
        monkeypatch.setattr(IndexDataCacheFile, method, lambda *arguments: None)
    monkeypatch.setattr(IndexDataCacheFile, part, full)
    module._say_that_nothing_is_kept.cache_clear()

    @compiled
    def total(x):
        return x.sum()

    with caplog.at_level(logging.WARNING):
        assert total(np.arange(3.0)) == 3.0
    assert len(caplog.messages) == 1


@pytest.mark.full
def test_a_function_is_compiled_anew_after_what_it_calls_has_changed(tmp_path):
    part = "from gdrl_tasks.compiled import compiled\n@compiled\ndef part(x):\n    return x"
    whole = part.replace("part(x)", "whole(x)").replace("return x", "return part(x)")
    (tmp_path / "whole.py").write_text(f"from part import part\n{whole}\n")
    program = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\nimport whole"
    results = []
    for change in ("", " + 10.0"):
        (tmp_path / "part.py").write_text(f"{part}{change}\n")
        done = subprocess.run(
            [sys.executable, "-c", f"{program}; print(whole.whole(1.0))"],
            env={k: v for k, v in os.environ.items() if not k.startswith("NUMBA")}
            | {"PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        results.append(done.stdout or done.stderr)
    assert results == ["1.0\n", "11.0\n"]
    assert list(tmp_path.rglob("*whole*.nbi"))
