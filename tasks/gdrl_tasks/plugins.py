"""What other packages offer by entry point. One that is broken stops nothing else."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points
from typing import Any

_logger = logging.getLogger(__name__)


class Offers(dict[str, Any]):
    """Things by name, and what is wrong with those that are ``broken``, by name.

    Examples:
        >>> Offers({"one": 1}, broken={"two": "'two' of a package cannot be used"})
        {'one': 1}
    """

    def __init__(
        self, working: Iterable[tuple[str, Any]] | dict[str, Any], broken: dict[str, str]
    ) -> None:
        super().__init__(working)
        self.broken = broken


@functools.cache
def offers_of(
    group: str, *, needs: tuple[str, ...] = (), taken: frozenset[str] = frozenset()
) -> Offers:
    """Load a group of entry points; what is wrong with one is told in a warning, once.

    Args:
        group: The group.
        needs: Attributes that what is offered must have.
        taken: Names that are not to be had.

    Examples:
        >>> offers_of("gdrl.nothing_offers_this")
        {}
    """
    offers = Offers({}, {})
    by_name: dict[str, list[EntryPoint]] = {}
    for entry in entry_points(group=group):
        by_name.setdefault(entry.name, []).append(entry)
    for name, entries in by_name.items():
        try:
            if name in taken:
                raise ValueError("its name is that of one of ours")
            if len(entries) > 1:
                raise ValueError("they have the same name")
            offers[name] = _loaded(entries[0], needs)
        # A package that is imported may raise anything, and must not end what imports it.
        except (Exception, SystemExit) as error:
            described = " and ".join(map(_described, entries))
            text = f"{described} cannot be used: {type(error).__name__}: {error}"
            # One line, whatever an error says.
            offers.broken[name] = " ".join(text.split())
            _logger.warning("%s", offers.broken[name])
    return offers


def _loaded(entry: EntryPoint, needs: tuple[str, ...]) -> Any:
    offered = entry.load()
    if missing := [name for name in needs if not hasattr(offered, name)]:
        raise TypeError(f"it has no {', no '.join(missing)}")
    return offered


def _described(entry: EntryPoint) -> str:
    package = (
        "a package" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
    )
    return f"{entry.name!r} of {package} (entry point {entry.group}: {entry.value})"
