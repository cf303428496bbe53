"""Where a run is put, and who may use its directory."""

from __future__ import annotations

import dataclasses
import errno

import pytest

from gdrl_torchrl.files import safe_files
from gdrl_torchrl.files.directory import RunDirectory
from gdrl_torchrl.files.errors import RunDirectoryError
from gdrl_torchrl.files.metrics import MetricsTable
from gdrl_torchrl.runs.place import directory_of, open_directory, run_key

COLUMNS = ("total_steps", "success_rate", "wall_s")
OTHER_WORDS = {
    "difficulty": "far",
    "sea": "rough",
    "reward": "dense",
    "at_limit": "truncated",
    "actions": "discrete",
    "activation": "relu",
    "mutation": "scaled",
    "crossover": "n_point",
    "contest": "paired",
    "share_on": "always",
    "mut_v_is": "variance",
    "fitness": "return",
    "tie_rule": "child",
    "act": "sampled",
    "rate_of": "contest",
    "genome": "head",
    "optimizer_on_switch": "reset",
    "critic_on_switch": "reset",
    "backend": "dm_control",
}
OTHER_LISTS = {
    "goal_distance_m": [0.8, 1.1],
    "extra_observations": ["roll"],
    "actor_cells": [4],
    "critic_cells": [4],
    "rates": [0.7, 0.4, 0.1],
    "thresholds": [0.3, 0.8],
    "success_range": [0.2, 0.9],
}
MULTIPLES = {"num_worlds": 8, "frames_per_batch": 80}


def another(name, value):
    """A valid value of a field that differs from the one that it has."""
    if name in OTHER_WORDS:
        return OTHER_WORDS[name]
    if name in OTHER_LISTS:
        return OTHER_LISTS[name]
    if name in MULTIPLES:
        return MULTIPLES[name]
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    return 0.5 if value is None else 0.5 * value + 0.03


def shaping_fields(config):
    for group in ("task", "algorithm", "network", "evolution"):
        part = getattr(config, group)
        for field in dataclasses.fields(part):
            if field.name not in ("name", "enabled"):
                yield group, field.name


def test_everything_that_shapes_learning_is_in_the_key(tiny):
    config = tiny()
    keys = {run_key(config)}
    fields = list(shaping_fields(config))
    for group, name in fields:
        part = getattr(config, group)
        value = getattr(part, name)
        changed = dataclasses.replace(part, **{name: another(name, value)})
        keys.add(run_key(dataclasses.replace(config, **{group: changed})))
    assert len(keys) == len(fields) + 1


def test_what_does_not_shape_learning_is_not_in_the_key(tiny):
    overrides = [
        "seed=7",
        "runs_dir=elsewhere",
        "force=true",
        "budget.agent_steps=7000",
        "budget.total_steps=7000",
        "budget.wall_s=7",
        "evaluation.episodes=7",
        "evaluation.seed=7",
        "checkpoint.interval_s=7",
        "checkpoint.keep=7",
        "logger.tensorboard=true",
        "logger.video_episodes=7",
        "simulation.num_threads=7",
    ]
    assert run_key(tiny(*overrides)) == run_key(tiny())


def test_options_of_an_evolution_that_is_off_are_not_in_the_key(tiny):
    off = "evolution.enabled=false"
    assert run_key(tiny(off)) == run_key(tiny(off, "evolution.num_children=7"))
    assert run_key(tiny(off)) != run_key(tiny())


def test_the_path_names_the_run(tiny, tmp_path):
    config = tiny("seed=3")
    parts = directory_of(config).path.relative_to(tmp_path / "runs").parts
    assert parts == ("gppo_water", run_key(config), "seed_3")
    assert not (tmp_path / "runs").exists(), "asking creates nothing"


def test_a_directory_in_use_is_refused_and_free_afterwards(tiny):
    directory = directory_of(tiny())
    with directory.locked():
        again = RunDirectory(directory.path).locked()
        with pytest.raises(RunDirectoryError, match="in use") as refused:
            again.__enter__()
        assert str(directory.path) in str(refused.value)
    with directory.locked():
        pass


def test_a_failure_inside_frees_the_lock(tiny):
    directory = directory_of(tiny())
    with pytest.raises(ZeroDivisionError), directory.locked():
        raise ZeroDivisionError
    with directory.locked():
        pass


def test_a_run_directory_that_is_no_folder_is_named(tiny, tmp_path):
    directory = directory_of(tiny())
    directory.path.parent.mkdir(parents=True)
    # As of a disk that is not mounted.
    directory.path.symlink_to(tmp_path / "nowhere")
    with pytest.raises(RunDirectoryError, match="seed_0 is not a folder"):
        directory.locked().__enter__()


def test_a_damaged_file_is_named(tiny):
    directory = directory_of(tiny())
    with directory.locked():
        open_directory(directory, tiny())
        (directory.path / "provenance.json").write_text('{"code": ')
        with pytest.raises(RunDirectoryError, match=r"provenance\.json"):
            open_directory(directory, tiny())


@pytest.mark.parametrize("name", ["provenance.json", "metrics.csv"])
def test_a_file_that_the_system_cannot_read_is_not_to_be_removed(name, tiny, monkeypatch):
    directory = directory_of(tiny())
    directory.path.mkdir(parents=True)
    (directory.path / name).write_text("{}")
    table = MetricsTable(directory.metrics, COLUMNS)

    def refuse(path):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(safe_files, "open_to_read", refuse)
    with pytest.raises((OSError, RunDirectoryError), match=f"{name}.*output error") as told:
        directory.read_json(name) if "json" in name else table.cut_after(0)
    for word in ("damaged", "remove", "move it"):
        assert word not in str(told.value)


def test_files_are_written_whole(tiny):
    directory = directory_of(tiny())
    directory.path.mkdir(parents=True)
    directory.write_json("a.json", {"x": 1})
    with pytest.raises(TypeError):
        directory.write_json("a.json", {"x": object()})
    assert directory.read_json("a.json") == {"x": 1}
    assert directory.read_json("b.json") is None
