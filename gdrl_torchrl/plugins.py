"""What other packages add: operators, algorithms and configurations, by entry point.

Groups: ``gdrl.mutations`` and ``gdrl.crossovers`` (functions), ``gdrl.algorithms``
(:class:`~gdrl_torchrl.agents.base.Algorithm`), ``gdrl.conf`` (packages of yaml files,
laid out like ours); tasks are in ``gdrl.tasks``, see :mod:`gdrl_tasks.registry`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gdrl_tasks.plugins import Offers, offers_of

__all__ = ["Offers", "conf_packages", "with_plugins"]


def with_plugins(
    own: Mapping[str, Any], group: str, *, needs: tuple[str, ...] = ()
) -> Offers:
    """Our own things by name, and those that other packages offer.

    What is broken, or has the name of one of ours or of another package's, is left out,
    with a warning that names it and its package; so does the error of whoever asks for it.

    Args:
        own: Ours.
        group: Group of entry points.
        needs: Attributes that what is offered must have.

    Examples:
        >>> with_plugins({"one": 1}, "gdrl.nothing_offers_this")
        {'one': 1}
    """
    offers = offers_of(group, needs=needs, taken=frozenset(own))
    return Offers({**own, **offers}, offers.broken)


def conf_packages() -> list[str]:
    """Packages of other distributions with configuration files, in order of name."""
    # Only a package has a path in which files can be looked for.
    offers = offers_of("gdrl.conf", needs=("__path__",))
    return sorted(package.__name__ for package in offers.values())
