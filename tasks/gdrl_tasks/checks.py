"""Checks of option values: errors name the option, the value and the range."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np


def as_tuple(name: str, values: Any) -> tuple:
    """A sequence of an option as a tuple; ValueError if it is none."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ValueError(f"{name}={values!r} must be a sequence")
    return tuple(values)


def check_choice(name: str, value: Any, choices: Any) -> None:
    """Raise ValueError unless a value is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name}={value!r} must be one of {sorted(choices)}")


def check_count(name: str, value: int, *, most: float = math.inf) -> None:
    """Raise ValueError unless a value is an integer from 1 to ``most``."""
    if not isinstance(value, int | np.integer):
        raise ValueError(f"{name}={value!r} must be an integer")
    check_range(name, value, least=1, most=most)


def check_range(
    name: str,
    value: Any,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    most: float = math.inf,
) -> None:
    """Raise ValueError unless a value is a finite number within the bounds."""
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not number or not (above < value and least <= value <= most) or value == math.inf:
        bounds = [f"> {above}"] if above > -math.inf else []
        bounds += [f">= {least}"] if least > -math.inf else []
        bounds += [f"<= {most}"] if most < math.inf else []
        raise ValueError(f"{name}={value!r} must be {' and '.join(bounds)}")


def check_times(control_interval_s: Any, substep_s: Any, step_limit: Any) -> None:
    """Raise ValueError unless substeps fill a control interval and there is a limit."""
    check_range("control_interval_s", control_interval_s, above=0.0, most=10.0)
    check_range("substep_s", substep_s, least=1e-4, most=0.1)
    ratio = control_interval_s / substep_s
    if ratio < 0.5 or abs(ratio - round(ratio)) > 1e-6 * ratio:
        raise ValueError(
            f"control_interval_s={control_interval_s} must be a multiple of "
            f"substep_s={substep_s}"
        )
    check_count("step_limit", step_limit)


def check_flag(name: str, value: Any) -> None:
    """Raise ValueError unless a value is a bool."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name}={value!r} must be a bool")
