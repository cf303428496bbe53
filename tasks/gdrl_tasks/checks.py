"""Checks of options: errors name the option, its value and what it must be.

The metadata of a dataclass's fields say which values are allowed. :func:`check_fields`
checks every field against its metadata and its type when an object is made.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np

_KINDS: dict[Any, tuple[Any, str]] = {
    bool: (bool, "True or False"),
    int: (int, "a whole number"),
    float: (int | float, "a number"),
    str: (str, "a text"),
    Any: (object, "anything"),
    types.NoneType: (types.NoneType, "None"),
}


@dataclasses.dataclass(frozen=True)
class Range:
    """The finite numbers within some bounds.

    Examples:
        >>> 3 in Range(least=1, most=5), float("nan") in Range()
        (True, False)
        >>> str(Range(above=0.0, most=1.0))
        '> 0.0 and <= 1.0'
    """

    above: float = -math.inf
    below: float = math.inf
    least: float = -math.inf
    most: float = math.inf

    def __contains__(self, value: Any) -> bool:
        inside = self.above < value < self.below and self.least <= value <= self.most
        # An infinite bound does not exclude infinity, and NaN passes no comparison.
        return inside and abs(value) < math.inf

    def __str__(self) -> str:
        bounds = [f"> {self.above}"] if self.above > -math.inf else []
        bounds += [f">= {self.least}"] if self.least > -math.inf else []
        bounds += [f"<= {self.most}"] if self.most < math.inf else []
        bounds += [f"< {self.below}"] if self.below < math.inf else []
        return " and ".join(bounds) or "that is finite"


def limits(*, lengths: tuple[int, int] | None = None, **bounds: float) -> dict[str, Any]:
    """Metadata of a field whose value, or every element of it, is in a :class:`Range`.

    Args:
        lengths: Fewest and most elements, if it is a sequence.
        **bounds: Bounds of the range.
    """
    return {"lengths": lengths, "range": Range(**bounds)}


def within(default: Any, **rules: Any) -> Any:
    """A field with a default and :func:`limits`."""
    return dataclasses.field(default=default, metadata=limits(**rules))


def among(default: Any, choices: Collection[str]) -> Any:
    """A field whose value, or every element of it, is one of the choices."""
    return dataclasses.field(default=default, metadata={"choices": choices})


def check_fields(options: Any, group: str = "") -> None:
    """Check every field of a dataclass's object against its type and its range.

    A value that only has another type is converted to that of the field: numbers of NumPy
    to Python's, sequences to tuples.

    Args:
        options: The object.
        group: Prefix of the names of its fields in errors.

    Raises:
        ValueError: If a value does not fit.

    Examples:
        >>> @dataclasses.dataclass
        ... class Options:
        ...     num_beams: int = within(19, least=1, most=360)
        >>> check_fields(Options(num_beams=0), "task")
        Traceback (most recent call last):
        ValueError: task.num_beams=0 must be a whole number >= 1 and <= 360
    """
    for field in dataclasses.fields(options):
        kind = _types(type(options))[field.name]
        value = _plain(getattr(options, field.name), kind)
        if not _fits(value, kind, field.metadata):
            name = f"{group}.{field.name}" if group else field.name
            raise ValueError(f"{name}={value!r} must be {_described(kind, field.metadata)}")
        # Options may be frozen, but may be changed here, while they are made.
        object.__setattr__(options, field.name, value)


def check_choice(name: str, value: Any, choices: Collection[str]) -> None:
    """Raise ValueError unless a value is one of the choices.

    Choices that know of broken ones, as :class:`~gdrl_tasks.plugins.Offers` do, say what
    is wrong with one that is asked for.
    """
    if isinstance(value, str) and value in choices:
        return
    text = f"{name}={value!r} must be one of {sorted(choices)}"
    broken: Mapping[Any, str] = getattr(choices, "broken", {})
    if isinstance(value, str) and value in broken:
        text += f"; {broken[value]}"
    raise ValueError(text)


def check_range(name: str, value: Any, **bounds: float) -> None:
    """Raise ValueError unless a value is a number in a :class:`Range`."""
    rules = {"range": Range(**bounds)}
    if not _fits(_plain(value, float), float, rules):
        raise ValueError(f"{name}={value!r} must be {_described(float, rules)}")


def check_times(control_interval_s: float, substep_s: float) -> None:
    """Raise ValueError unless whole substeps fill a control interval."""
    ratio = control_interval_s / substep_s
    if ratio < 0.5 or abs(ratio - round(ratio)) > 1e-6 * ratio:
        raise ValueError(
            f"control_interval_s={control_interval_s} must be a multiple of "
            f"substep_s={substep_s}"
        )


def described(owner: type, name: str) -> str:
    """What the value of a dataclass's field must be, in words.

    Examples:
        >>> @dataclasses.dataclass
        ... class Options:
        ...     num_beams: int = within(19, least=1, most=360)
        >>> described(Options, "num_beams")
        'a whole number >= 1 and <= 360'
    """
    (field,) = (field for field in dataclasses.fields(owner) if field.name == name)
    return _described(_types(owner)[name], field.metadata)


@functools.cache
def _types(owner: type) -> dict[str, Any]:
    return typing.get_type_hints(owner)


def _parts(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """Union, Literal, list, tuple, dict or None, and the types that it is made of."""
    origin = typing.get_origin(kind)
    parts = tuple(part for part in typing.get_args(kind) if part is not Ellipsis)
    return (typing.Union if origin is types.UnionType else origin), parts


def _plain(value: Any, kind: Any) -> Any:
    """A value converted to its field's type, if it differs only in type."""
    origin, parts = _parts(kind)
    is_sequence = isinstance(value, Iterable) and not isinstance(value, str)
    if is_sequence and tuple in (origin, *map(typing.get_origin, parts)):
        return tuple(_plain(element, None) for element in value)
    return value.item() if isinstance(value, np.generic) else value


def _fits(value: Any, kind: Any, rules: Mapping[str, Any]) -> bool:
    origin, parts = _parts(kind)
    if origin is typing.Union:
        return any(_fits(value, part, rules) for part in parts)
    if origin is typing.Literal:
        return isinstance(value, str) and value in parts
    if origin in (list, tuple):
        fewest, most = rules.get("lengths") or (0, math.inf)
        fits = isinstance(value, origin) and fewest <= len(value) <= most
        return fits and all(_fits(element, parts[0], rules) for element in value)
    if origin is dict:
        return isinstance(value, dict) and all(
            _fits(element, part, rules)
            for pair in value.items()
            for element, part in zip(pair, parts, strict=True)
        )
    if not isinstance(value, _KINDS.get(kind, (kind,))[0]):
        return False
    if kind in (int, float):
        # To Python True is a whole number.
        return not isinstance(value, bool) and value in rules.get("range", Range())
    return kind is not str or value in rules.get("choices", (value,))


def _described(kind: Any, rules: Mapping[str, Any]) -> str:
    origin, parts = _parts(kind)
    if origin is typing.Union:
        return " or ".join(_described(part, rules) for part in parts)
    if origin is typing.Literal or (kind is str and "choices" in rules):
        return f"one of {sorted(rules.get('choices', parts))}"
    if origin in (list, tuple):
        lengths = dict.fromkeys(rules.get("lengths") or ())
        size = f" of {' to '.join(map(str, lengths))}" if lengths else ""
        return f"a list{size}, each {_described(parts[0], rules)}"
    if origin is dict:
        return f"a dict of {_described(parts[0], rules)} to {_described(parts[1], rules)}"
    words = _KINDS[kind][1] if kind in _KINDS else f"a {kind.__name__}"
    return f"{words} {rules.get('range', Range())}" if kind in (int, float) else words
