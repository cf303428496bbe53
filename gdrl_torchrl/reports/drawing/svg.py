"""Figures of matplotlib as SVG that can stand in a page, with what a pointer shows."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

import matplotlib
from matplotlib.figure import Figure

_SVG = "http://www.w3.org/2000/svg"
_LINK = "http://www.w3.org/1999/xlink"
_OPTIONS: Any = {
    # Text stays text: it can be found, and is read aloud.
    "svg.fonttype": "none",
    # The same data give the same file.
    "svg.hashsalt": "gdrl-report",
}
_NOTHING = dict.fromkeys(("Creator", "Date", "Format", "Type"))
_WIDE = "5"
"""Width of what a pointer meets around a thin line, points."""


def svg_of(figure: Figure, name: str, alt: str, titles: Mapping[str, str]) -> str:
    """Draw a figure.

    Args:
        figure: The figure.
        name: Put before every id, so that several drawings can be in one page.
        alt: What is seen, for those who cannot.
        titles: What a pointer shows, by the gid of an artist; it becomes a group of class
            ``seed``.

    Returns:
        An ``svg`` element.
    """
    buffer = io.StringIO()
    with matplotlib.rc_context(_OPTIONS):
        figure.savefig(buffer, format="svg", metadata=_NOTHING)
    ElementTree.register_namespace("", _SVG)
    ElementTree.register_namespace("xlink", _LINK)
    root = ElementTree.fromstring(buffer.getvalue())
    _without_style(root)
    root.set("role", "img")
    root.set("aria-label", alt)
    root.set("stroke-linejoin", "round")
    for group in root.iter(f"{{{_SVG}}}g"):
        title = titles.get(group.get("id", ""))
        if title is not None:
            _add_title(group, title)
    _rename(root, name)
    return ElementTree.tostring(root, encoding="unicode")


def _without_style(root: ElementTree.Element) -> None:
    """Take out rules and notes that would be those of the whole page."""
    for parent in root.iter():
        for child in list(parent):
            if child.tag in (f"{{{_SVG}}}style", f"{{{_SVG}}}metadata"):
                parent.remove(child)


def _add_title(group: ElementTree.Element, text: str) -> None:
    group.set("class", "seed")
    for path in list(group.iter(f"{{{_SVG}}}path")):
        if "fill: none" in path.get("style", ""):
            # A thin line is hard to hit.
            wide = f"fill: none; stroke: #000; stroke-opacity: 0; stroke-width: {_WIDE}"
            around = {**path.attrib, "style": wide, "class": "around"}
            group.append(ElementTree.Element(f"{{{_SVG}}}path", around))
    title = ElementTree.Element(f"{{{_SVG}}}title")
    title.text = text
    group.insert(0, title)


def _rename(root: ElementTree.Element, name: str) -> None:
    """Put a name before all ids and what points to them."""
    for element in root.iter():
        for key, value in element.attrib.items():
            if key == "id":
                element.set(key, f"{name}-{value}")
            elif key == f"{{{_LINK}}}href":
                element.set(key, value.replace("#", f"#{name}-", 1))
            elif "url(#" in value:
                element.set(key, re.sub(r"url\(#", f"url(#{name}-", value))
