"""What a page consists of, whether it becomes HTML or Markdown."""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

from gdrl_torchrl.reports.statistics.bootstrap import Estimate


@dataclasses.dataclass(frozen=True)
class Panel:
    """A drawing.

    Attributes:
        name: Of its file, and before the ids in it.
        alt: What is seen, for those who cannot.
        svg: The drawing.
    """

    name: str
    alt: str
    svg: str


@dataclasses.dataclass(frozen=True)
class Text:
    """A paragraph."""

    kind: ClassVar[str] = "text"
    panels: ClassVar[tuple[Panel, ...]] = ()
    text: str


@dataclasses.dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        caption: What it shows.
        columns: Heads of its columns.
        rows: Cells, as many in each as there are columns.
        folded: Whether it is shown only on demand.
    """

    kind: ClassVar[str] = "table"
    panels: ClassVar[tuple[Panel, ...]] = ()
    caption: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    folded: bool = False


@dataclasses.dataclass(frozen=True)
class Figure:
    """Drawings beside each other, with what they come from.

    Attributes:
        caption: What they show.
        panels: The drawings.
        sources: Commands and hashes.
    """

    kind: ClassVar[str] = "figure"
    caption: str
    panels: tuple[Panel, ...]
    sources: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        name: Its id.
        title: Its title.
        blocks: What is in it.
    """

    name: str
    title: str
    blocks: tuple[Text | Table | Figure, ...]


UNKNOWN = "–"
_NO_BREAK = "\N{NO-BREAK SPACE}"


def number(value: float, digits: int = 3) -> str:
    """A number as text.

    Examples:
        >>> number(0.12345), number(float("nan")), number(float("inf"))
        ('0.123', '–', 'not reached')
    """
    if math.isnan(value):
        return UNKNOWN
    if math.isinf(value):
        return "not reached"
    return f"{value:.{digits}f}"


def count(value: float) -> str:
    """A large number as text.

    Examples:
        >>> count(1234567.8), count(float("inf"))
        ('1,234,568', 'not reached')
    """
    return f"{value:,.0f}" if math.isfinite(value) else number(value)


def with_limits(estimate: Estimate, digits: int = 3) -> str:
    r"""An estimate and its interval.

    Examples:
        >>> with_limits(Estimate(0.5, 0.25, 0.75), 2), with_limits(Estimate(0.5), 2)
        ('0.50\xa0[0.25,\xa00.75]', '0.50')
    """
    if math.isnan(estimate.low):
        return number(estimate.value, digits)
    value, low, high = (number(x, digits) for x in dataclasses.astuple(estimate))
    return f"{value} [{low}, {high}]".replace(" ", _NO_BREAK)


def p_value(p: float) -> str:
    r"""A p value as text.

    Examples:
        >>> p_value(0.0321), p_value(0.00001)
        ('0.032', '<\xa00.001')
    """
    return f"<{_NO_BREAK}0.001" if p < 0.001 else number(p)
