"""What the files of a run may hold; errors name the file, the field and the value."""

from __future__ import annotations

import dataclasses
import json
import math
import reprlib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gdrl_torchrl.files.safe_files import read_content

_MOST_BYTES = 2**30
"""Of a text: a table of a million rows has some hundred million."""
_MOST_BYTES_OF_OBJECT = 2**24
_MOST_LEVELS = 32
"""Of lists and objects in each other; what a run writes has less than ten."""


@dataclasses.dataclass(frozen=True)
class Kind:
    """What a value must be: in words, and as a test."""

    what: str
    fits: Callable[[Any], bool]

    def check(self, value: Any, name: str) -> None:
        """Raise ValueError with a name unless a value fits.

        Examples:
            >>> RATE.check(1.5, "mut_p")
            Traceback (most recent call last):
            ValueError: mut_p=1.5 must be a number from 0 to 1
        """
        if not self.fits(value):
            raise ValueError(f"{name}={reprlib.repr(value)} must be {self.what}")


def _is_whole(value: Any) -> bool:
    # True is a whole number to Python.
    return isinstance(value, int) and not isinstance(value, bool)


def _is_between(value: Any, least: float, most: float) -> bool:
    # NaN passes no comparison.
    return (_is_whole(value) or isinstance(value, float)) and least <= value <= most


COUNT = Kind("a whole number >= 0", lambda x: _is_whole(x) and 0 <= x < 2**64)
SOME = Kind("a whole number >= 1", lambda x: _is_whole(x) and 1 <= x < 2**64)
SECONDS = Kind("a number >= 0", lambda x: _is_between(x, 0.0, 1e12))
RATE = Kind("a number from 0 to 1", lambda x: _is_between(x, 0.0, 1.0))
NUMBER = Kind("a number", lambda x: _is_between(x, -math.inf, math.inf) or x != x)
TEXT = Kind(
    "a text of 1 to 255 letters that can be printed",
    lambda x: isinstance(x, str) and 0 < len(x) < 256 and x.isprintable(),
)
SWITCH = Kind("true or false", lambda x: isinstance(x, bool))
OBJECT = Kind("an object", lambda x: isinstance(x, dict))
DIGEST = Kind(
    "64 hexadecimal digits",
    lambda x: isinstance(x, str) and len(x) == 64 and set(x) <= set("0123456789abcdef"),
)


def read_text(path: Path, most_bytes: int = _MOST_BYTES) -> str:
    """Read a file of text.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is not a file of text in UTF-8.
    """
    try:
        return read_content(path, most_bytes).decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not text in UTF-8: {error}") from error


def read_object(
    path: Path,
    required: Mapping[str, Kind] = MappingProxyType({}),
    optional: Mapping[str, Kind] = MappingProxyType({}),
) -> dict[str, Any]:
    """Read an object in JSON.

    Args:
        path: The file.
        required: What its fields must be; ``"a.b"`` is field ``b`` of object ``a``.
        optional: The same for fields that may be missing; without dots.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not JSON, or a field is missing or not what it must be.
    """
    text = read_text(path, _MOST_BYTES_OF_OBJECT)
    try:
        content = json.loads(text, object_pairs_hook=_without_twins)
        if _has_levels(content, _MOST_LEVELS):
            raise ValueError(f"more than {_MOST_LEVELS} levels")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from error
    OBJECT.check(content, f"{path}: all of it")
    for name, kind in required.items():
        kind.check(_field(content, name, path), f"{path}: {name}")
    for name, kind in optional.items():
        if name in content:
            kind.check(content[name], f"{path}: {name}")
    return content


def _field(content: dict[str, Any], name: str, path: Path) -> Any:
    value: Any = content
    for part in name.split("."):
        OBJECT.check(value, f"{path}: what holds {name}")
        if part not in value:
            raise ValueError(f"{path} has no {name}")
        value = value[part]
    return value


def _without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        raise ValueError(f"a name is there twice in {reprlib.repr(names)}")
    return dict(pairs)


def _has_levels(value: Any, levels: int) -> bool:
    """Whether there are more levels than this of lists and objects in each other."""
    if not isinstance(value, (dict, list)):
        return False
    items = value.values() if isinstance(value, dict) else value
    return levels == 0 or any(_has_levels(item, levels - 1) for item in items)
