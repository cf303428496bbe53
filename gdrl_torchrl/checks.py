"""Checks of configured values, whose errors name the field and the value."""

from __future__ import annotations

import itertools
from typing import Any

from gdrl_tasks.checks import (
    among,
    check_choice,
    check_fields,
    check_range,
    limits,
    within,
)

__all__ = [
    "MOST_EPISODES",
    "MOST_SEED",
    "MOST_STEPS",
    "MOST_WEIGHTS",
    "MOST_WORLDS",
    "among",
    "check_at_most",
    "check_choice",
    "check_evaluation_worlds",
    "check_fields",
    "check_folder",
    "check_range",
    "check_weights",
    "limits",
    "num_weights",
    "within",
]
MOST_SEED = 2**62
"""Seeds of torch's generators have 64 bits, and some of ours are sums."""
MOST_STEPS = 10**12
MOST_EPISODES = 1_000_000
MOST_WORLDS = 100_000
"""A world takes some kilobytes of memory and ten microseconds a step."""
MOST_WEIGHTS = 2**24
"""Of a network; the largest that a sweep of ours takes has a thousandth of that."""
_LONGEST_NAME = 200
"""Bytes: file systems take 255, and a run's folder adds to some names."""


def check_folder(name: str, value: str) -> None:
    """Raise ValueError unless a value can be the name of a folder."""
    special = value in ("", ".", "..") or "/" in value or not value.isprintable()
    if special or len(value.encode()) > _LONGEST_NAME:
        raise ValueError(
            f"{name}={value!r} must be a folder's name of 1 to {_LONGEST_NAME} bytes"
        )


def num_weights(widths: list[int]) -> int:
    """Weights between hidden layers.

    Examples:
        >>> num_weights([64, 32, 8])
        2304
    """
    return sum(one * other for one, other in itertools.pairwise(widths))


def check_weights(name: str, widths: list[int]) -> None:
    """Raise ValueError if there are more weights between hidden layers than may be.

    Each width may be large alone; together they would fill any memory.
    """
    if num_weights(widths) > MOST_WEIGHTS:
        raise ValueError(
            f"{name}={widths} must have at most {MOST_WEIGHTS} weights between its layers, "
            f"not {num_weights(widths)}"
        )


def check_at_most(group: str, options: Any, smaller: str, larger: str) -> None:
    """Raise ValueError if one field is larger than another."""
    low, high = getattr(options, smaller), getattr(options, larger)
    if low > high:
        raise ValueError(f"{group}.{smaller}={low} must be <= {group}.{larger}={high}")


def check_evaluation_worlds(group: str, options: Any, field: str, members: int) -> None:
    """Raise ValueError if a world per member and trial would be too many of them.

    Args:
        group: The options' group.
        options: With ``num_trials`` and ``num_worlds``.
        field: What the number of members depends on.
        members: How many play.
    """
    worlds = members * options.num_trials
    if options.num_worlds is None and worlds > MOST_WORLDS:
        raise ValueError(
            f"{group}.num_worlds=None must be a number: {worlds} worlds, one per member "
            f"and trial of {group}.{field}={getattr(options, field)} and "
            f"{group}.num_trials={options.num_trials}, are more than {MOST_WORLDS}"
        )
