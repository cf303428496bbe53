"""The only place that knows Hydra: registering schemas, turning configs to objects."""

from __future__ import annotations

import copy
import functools
import json
import threading
from typing import Any, TypeVar

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf

from gdrl_tasks import task_names
from gdrl_torchrl.agents.registry import algorithm_configs
from gdrl_torchrl.cli.shared.errors import check_known, explained, not_among
from gdrl_torchrl.cli.shared.names import CONFIG_MODULE, names_in
from gdrl_torchrl.config import schema
from gdrl_torchrl.config.search import SearchConfig
from gdrl_torchrl.config.study import StudyConfig
from gdrl_torchrl.config.task import task_config_class
from gdrl_torchrl.config.toy import as_toy
from gdrl_torchrl.evolution.settings import EVOLUTIONS
from gdrl_torchrl.plugins import conf_packages

_Part = TypeVar("_Part")
_PROVIDER = "gdrl_torchrl"
_COMPOSING = threading.RLock()
EXIT_SAVED = 75
"""Exit code of a command that a signal ended once it had saved: ``EX_TEMPFAIL`` of
sysexits.h, try again. The same command goes on."""


class _NotCopied(dict[str, Any]):
    """A dict that copies of what holds it share."""

    def __deepcopy__(self, memo: dict[int, Any]) -> _NotCopied:
        return self


@functools.cache
def register_configs() -> None:
    """Store every schema in Hydra's ConfigStore under our own provider."""
    store = ConfigStore.instance()
    # Hydra copies the store, of which there is only one, whenever it looks up a group:
    # 85 times for --help, half of its time. What is read from it is copied anyway.
    store.repo = _NotCopied(store.repo)

    def add(name: str, node: Any, group: str | None = None) -> None:
        store.store(name=name, node=node, group=group, provider=_PROVIDER)

    add("experiment_config", schema.ExperimentConfig)
    for name, node in algorithm_configs().items():
        add(f"{name}_config", node, "algorithm")
    add("search_config", SearchConfig, "search")
    add("study_config", StudyConfig, "study")
    add("network_config", schema.NetworkConfig, "network")
    for name, node in EVOLUTIONS.items():
        add(f"{name}_config", node, "evolution")
    for name in task_names():
        add(f"{name}_config", task_config_class(name), "task")


def search_path() -> list[str]:
    """The override that adds other packages' configurations, if there are any."""
    packages = ",".join(f"pkg://{package}" for package in conf_packages())
    return [f"hydra.searchpath=[{packages}]"] if packages else []


def to_experiment(config: DictConfig) -> schema.ExperimentConfig:
    """Make the typed configuration of a composed one.

    Raises:
        ValueError: If an option is unknown, or a value is missing or out of range.
    """
    check_known(config)
    with explained([]):
        experiment = OmegaConf.to_object(config)
    assert isinstance(experiment, schema.ExperimentConfig)
    return as_toy(experiment) if experiment.toy else experiment


def load_experiment(overrides: list[str]) -> schema.ExperimentConfig:
    """Compose a configuration as the command line would.

    Examples:
        >>> load_experiment(["experiment=gppo_water", "seed=3"]).seed
        3
    """
    return to_experiment(composed("config", overrides))


def composed(name: str, overrides: list[str]) -> DictConfig:
    """One of our configuration files with overrides.

    An application that has set Hydra up for itself finds it as it was.

    Raises:
        ValueError: If there is no such file, or an override is not valid.
    """
    register_configs()
    # Hydra has one configuration per process, whatever the threads.
    with _COMPOSING:
        others = GlobalHydra.instance().hydra
        version_base = copy.copy(VersionBase.instance())
        GlobalHydra.instance().clear()
        try:
            with (
                explained(overrides),
                initialize_config_module(CONFIG_MODULE, version_base="1.3"),
            ):
                return compose(name, overrides=[*search_path(), *overrides])
        finally:
            GlobalHydra.instance().hydra = others
            VersionBase.set_instance(version_base)


def composed_part(
    kind: type[_Part], group: str, argument: str, name: str, own: list[str]
) -> _Part:
    """A configuration that stands beside those of runs, such as a search.

    Args:
        kind: Its class.
        group: Its folder, and the name of its section.
        argument: What it is chosen with on the command line.
        name: Its file.
        own: Overrides of its options.

    Raises:
        ValueError: If there is no such file, or an override is not valid.
    """
    if name not in names_in(group):
        raise ValueError(not_among(argument, name, names_in(group)))
    config = composed(f"{group}/{name}", own)
    with explained(own):
        check_known(config)
        part = OmegaConf.to_object(config[group])
    assert isinstance(part, kind)
    return part


def check_plain(task: dict[str, Any]) -> None:
    """Raise ValueError if a saved task has words for what is elsewhere.

    OmegaConf would fetch it, as from the environment; none is ever saved.
    """
    if "${" in json.dumps(task):
        raise ValueError(f"task={task} must hold no ${{...}}")


def merge_task(saved: dict[str, Any], overrides: list[str]) -> Any:
    """A saved task configuration with ``option=value`` overrides.

    Raises:
        ValueError: If an option is unknown or its value has the wrong type, or what was
            saved refers to what is elsewhere.
    """
    check_plain(saved)
    base = OmegaConf.structured(task_config_class(saved["name"])(**saved))
    # Named as they were given.
    given = [f"task.{override}" for override in overrides]
    with explained(given):
        merged = OmegaConf.merge({"task": base}, OmegaConf.from_dotlist(given))
        return OmegaConf.to_object(OmegaConf.select(merged, "task"))
