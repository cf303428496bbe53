"""Every option by its name on the command line: its field, and what is near a name."""

from __future__ import annotations

import dataclasses
import difflib
import re
import typing
from typing import Any

from gdrl_tasks import task_names
from gdrl_tasks.checks import described
from gdrl_torchrl.agents.registry import algorithm_configs
from gdrl_torchrl.config.schema import ExperimentConfig
from gdrl_torchrl.config.task import task_config_class
from gdrl_torchrl.evolution.settings import EVOLUTIONS

_FACTORS = {"": 1, "k": 10**3, "m": 10**6}


def section_classes() -> list[tuple[str, type]]:
    """Dataclasses of an experiment's options and the sections that they are of.

    Examples:
        >>> ("budget", "BudgetConfig") in [(s, c.__name__) for s, c in section_classes()]
        True
    """
    hints = typing.get_type_hints(ExperimentConfig)
    parts = {name: kind for name, kind in hints.items() if dataclasses.is_dataclass(kind)}
    return [
        ("", ExperimentConfig),
        *((name, typing.cast("type", kind)) for name, kind in parts.items()),
        *(("algorithm", owner) for owner in algorithm_configs().values()),
        *(("evolution", owner) for owner in EVOLUTIONS.values()),
        *(("task", task_config_class(name)) for name in task_names()),
    ]


def owner_of(name: str) -> type | None:
    """The first dataclass that has an option, by its full name; None if there is none."""
    section, _, field = name.rpartition(".")
    for found, owner in section_classes():
        if found == section and field in _names(owner):
            return owner
    return None


def unknown_option(given: str, name: str, owner: type | None = None) -> str:
    """What is said of an option that does not exist: the nearest that does.

    Args:
        given: What was given, ``name=value``.
        name: The option's full name.
        owner: The dataclass of its section, if that is known.

    Examples:
        >>> from gdrl_torchrl.agents.registry import PPOConfig
        >>> unknown_option("+algorithm.gama=0.5", "algorithm.gama", PPOConfig)
        '+algorithm.gama=0.5 must be an option that exists: did you mean algorithm.gamma?'
        >>> unknown_option("gamma=0.5", "gamma")
        'gamma=0.5 must be an option that exists: did you mean algorithm.gamma?'
    """
    section, _, last = name.rpartition(".")
    own = _names(owner)
    names = {
        f"{s}.{field}".lstrip("."): field
        for s, c in section_classes()
        for field in _names(c)
    }
    names["experiment"] = "experiment"
    said = f"{given} must be an option that exists"
    if near := nearest(last, own):
        return f"{said}: did you mean {section}.{near}?".replace(" .", " ")
    for known, field in names.items():
        if field == last:
            return f"{said}: did you mean {known}?"
    alike = [known for known in names if ("." in known) == ("." in name)]
    if near := nearest(name, alike, cutoff=0.8):
        return f"{said}: did you mean {near}?"
    return f"{said}: options are {', '.join(own)}" if own else said


def wrong_type(given: str, name: str, owner: type | None = None) -> str:
    """What is said of a value that its option cannot hold.

    Arguments as of :func:`unknown_option`.

    Examples:
        >>> wrong_type("evaluation.episodes=1e3", "evaluation.episodes")
        'evaluation.episodes=1e3 must be a whole number >= 1 and <= 1000000: write 1_000'
    """
    plain = re.sub(r"\[\d+\]$", "", name)
    field = plain.rpartition(".")[2]
    if owner is None or field not in _names(owner):
        owner = owner_of(plain)
    if owner is None:
        return f"{given} must be of another type"
    if field in dict(section_classes()):
        return f"{given} must be given by its options, such as {name}.<option>=<value>"
    must = described(owner, field)
    number = _as_whole(given.partition("=")[2])
    written = f": write {number:_}" if number and must.startswith("a whole") else ""
    return f"{given} must be {must}{written}"


def nearest(name: str, names: typing.Iterable[str], *, cutoff: float = 0.6) -> str | None:
    """The name that is most like another one, if one is by more than a cutoff.

    Examples:
        >>> nearest("gpo_water", ["gppo_water", "ga_indoor"])
        'gppo_water'
    """
    near = difflib.get_close_matches(name, list(names), n=1, cutoff=cutoff)
    return near[0] if near else None


def _names(owner: Any) -> list[str]:
    if owner is None or not dataclasses.is_dataclass(owner):
        return []
    return [field.name for field in dataclasses.fields(owner)]


def _as_whole(text: str) -> int | None:
    """The whole number that ``1e5``, ``150k`` or ``2.5M`` means."""
    found = re.fullmatch(r"'?(\d+(?:\.\d+)?(?:e\+?\d{1,2})?)([km]?)'?", text.lower())
    if not found:
        return None
    number = float(found[1]) * _FACTORS[found[2]]
    return int(number) if number == int(number) else None
