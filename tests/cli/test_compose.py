"""Configurations are composed within whatever else uses Hydra."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.version import getbase

from gdrl_torchrl.cli.search import load_search
from gdrl_torchrl.cli.shared.compose import load_experiment


@pytest.fixture
def application(tmp_path):
    """An application that has set Hydra up for itself."""
    (tmp_path / "own.yaml").write_text("ours: false\n")
    with initialize_config_dir(str(tmp_path), version_base="1.2"):
        yield


@pytest.mark.parametrize("fails", [False, True])
def test_an_application_that_has_set_hydra_up_finds_it_as_it_was(application, fails):
    hydra, base = GlobalHydra.instance().hydra, getbase()
    if fails:
        with pytest.raises(Exception, match="no_such_thing"):
            load_experiment(["experiment=no_such_thing"])
    else:
        assert load_experiment(["experiment=grainbow_indoor"]).task.name == "indoor"
        assert load_search(["+search=gppo_water"]).name == "search_gppo_water"
    assert GlobalHydra.instance().hydra is hydra
    assert getbase() == base
    assert compose("own") == {"ours": False}


def test_threads_compose_at_the_same_time():
    with ThreadPoolExecutor(4) as pool:
        seeds = pool.map(lambda n: load_experiment([f"seed={n}"]).seed, range(12))
        assert list(seeds) == list(range(12))
    assert not GlobalHydra.instance().is_initialized()
