"""What every option means: the text below its field, read from the source."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import re
import textwrap
from typing import Any

from gdrl_tasks.checks import described


@functools.cache
def sentences_of(owner: type) -> dict[str, str]:
    """What the fields of a dataclass mean, by name; empty where nothing is said.

    Examples:
        >>> from gdrl_torchrl.config.schema import EvaluationConfig
        >>> sentences_of(EvaluationConfig)["episodes"]
        'Held-out episodes.'
    """
    found = {field.name: "" for field in dataclasses.fields(owner)}
    try:
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
    except (OSError, TypeError, SyntaxError, ValueError):
        # Another package's may come without its source.
        return found
    assert isinstance(body, ast.ClassDef)
    for before, after in zip(body.body, body.body[1:], strict=False):
        if isinstance(before, ast.AnnAssign) and isinstance(before.target, ast.Name):
            match after:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    found[before.target.id] = " ".join(text.replace("``", "").split())
                case _:
                    pass
    return found


def options_of(owner: type, section: str) -> list[tuple[str, str]]:
    """Options as they are given, with their defaults, and what they mean.

    Examples:
        >>> from gdrl_torchrl.config.schema import EvaluationConfig
        >>> options_of(EvaluationConfig, "evaluation")[0]
        ('evaluation.episodes=500', 'Held-out episodes.')
    """
    rows = []
    for field in dataclasses.fields(owner):
        factory = field.default_factory
        default = field.default if factory is dataclasses.MISSING else factory()
        if not dataclasses.is_dataclass(default):
            name = f"{section}.{field.name}" if section else field.name
            meaning = f"{sentences_of(owner)[field.name]}{_choices(owner, field.name)}"
            rows.append((f"{name}={_as_given(default)}", meaning))
    return rows


def _choices(owner: type, name: str) -> str:
    """The words that an option may be, if it is one of some."""
    found = re.search(r"one of \[(.+?)\]", described(owner, name))
    return "" if found is None else f" One of {found[1].replace(chr(39), '')}."


def _as_given(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, (list, tuple)):
        return f"[{','.join(map(_as_given, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)
