"""What other packages add: operators, algorithms and configurations, by entry point.

Groups: ``gdrl.mutations`` and ``gdrl.crossovers`` (functions), ``gdrl.algorithms``
(:class:`~gdrl_torchrl.training.agent.Algorithm`), ``gdrl.conf`` (packages of yaml files,
laid out like ours); tasks are in ``gdrl.tasks``, see :mod:`gdrl_tasks.registry`.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any


def with_plugins(own: Mapping[str, Any], group: str) -> dict[str, Any]:
    """Our own things by name, and those that other packages offer.

    Args:
        own: Ours.
        group: Group of entry points.

    Raises:
        ValueError: If a name is taken.

    Examples:
        >>> with_plugins({"one": 1}, "gdrl.nothing_offers_this")
        {'one': 1}
    """
    found = dict(own)
    for name, (plugin, value) in _loaded(group).items():
        if name in own:
            raise ValueError(f"{group}: {name!r} of {value} is the name of one of ours")
        found[name] = plugin
    return found


def plugin_names(group: str) -> list[str]:
    """Names of what other packages offer in a group; nothing of theirs is imported.

    Examples:
        >>> plugin_names("gdrl.nothing_offers_this")
        []
    """
    return sorted({entry.name for entry in entry_points(group=group)})


def conf_packages() -> list[str]:
    """Packages of other distributions with configuration files, in order of name."""
    return sorted(entry.value for entry in entry_points(group="gdrl.conf"))


@functools.cache
def _loaded(group: str) -> dict[str, tuple[Any, str]]:
    loaded: dict[str, tuple[Any, str]] = {}
    for entry in entry_points(group=group):
        if entry.name in loaded:
            raise ValueError(
                f"{group}: {entry.name!r} is offered by {loaded[entry.name][1]} and by "
                f"{entry.value}"
            )
        loaded[entry.name] = entry.load(), entry.value
    return loaded
