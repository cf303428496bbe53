"""Checks of configured values, whose errors name the field and the value."""

from __future__ import annotations

import math
from typing import Any


def check_choice(name: str, value: Any, choices: Any) -> None:
    """Raise ValueError unless a value is one of the choices."""
    if value not in choices:
        raise ValueError(f"{name}={value!r} must be one of {sorted(choices)}")


def check_range(
    name: str,
    value: float,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    least: float = -math.inf,
    most: float = math.inf,
) -> None:
    """Raise ValueError unless ``above < value < below``, ``least <= value <= most``."""
    inside = above < value < below and least <= value <= most
    if not (inside and math.isfinite(value)):
        bounds = [f"> {above:g}"] if above > -math.inf else []
        bounds += [f">= {least:g}"] if least > -math.inf else []
        bounds += [f"<= {most:g}"] if most < math.inf else []
        bounds += [f"< {below:g}"] if below < math.inf else []
        raise ValueError(f"{name}={value} must be {' and '.join(bounds) or 'finite'}")


def check_folder(name: str, value: str) -> None:
    """Raise ValueError unless a value can be the name of a folder."""
    if value in ("", ".", "..") or "/" in value:
        raise ValueError(f"{name}={value!r} must be a folder's name")
