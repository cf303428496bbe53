"""Which parameters of a test wait for ``make test-full``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def full_but(quick: Iterable[Any], every: Iterable[Any]) -> list[Any]:
    """All values of a parameter, of which only the quick ones are in ``make test``."""
    kept, values = list(quick), list(every)
    assert kept, "of every behaviour something stays quick"
    assert all(value in values for value in kept), f"{kept} must be among {values}"
    return [pytest.param(v, marks=[pytest.mark.full] * (v not in kept)) for v in values]


def _of_each(quick: str) -> pytest.MarkDecorator:
    """For tests that take ``tiny_of_each``: the other one is only in ``make test-full``."""
    both = ["tiny", "tiny_rainbow"]
    ids = ["gppo", "grainbow"]
    return pytest.mark.parametrize(
        "tiny_of_each", full_but([quick], both), ids=ids, indirect=True
    )


gppo_is_quick = _of_each("tiny")
grainbow_is_quick = _of_each("tiny_rainbow")
