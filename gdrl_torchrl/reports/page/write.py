"""Sections as a page of HTML, and as Markdown with figures beside it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import jinja2

from gdrl_torchrl.files.safe_files import own_folder, written_aside
from gdrl_torchrl.reports.page.content import Panel, Section

_SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|$])")


def write_pages(folder: Path, title: str, sections: Sequence[Section]) -> Path:
    """Write ``report.html``, ``report.md`` and ``figures/*.svg``.

    Args:
        folder: Where; it is made.
        title: Of the page.
        sections: What is in it.

    Returns:
        The page of HTML, which needs no other file.

    Raises:
        OSError: If a file cannot be written.
    """
    pages = jinja2.Environment(
        loader=jinja2.PackageLoader("gdrl_torchrl.reports.page"),
        autoescape=jinja2.select_autoescape(["html.jinja"]),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
    )
    pages.filters |= {"plain": plain, "table": lambda t: markdown_table(t.columns, t.rows)}
    own_folder(folder / "figures")
    for panel in panels_of(sections):
        _write(folder / "figures" / f"{panel.name}.svg", panel.svg + "\n")
    for name in ("report.md", "report.html"):
        page = pages.get_template(f"{name}.jinja")
        _write(folder / name, page.render(title=title, sections=sections))
    return folder / "report.html"


def panels_of(sections: Iterable[Section]) -> list[Panel]:
    """All drawings in their order."""
    blocks = [block for section in sections for block in section.blocks]
    return [panel for block in blocks for panel in block.panels]


def plain(text: str) -> str:
    r"""A text that Markdown shows as it is, on one line.

    Examples:
        >>> plain("water_near | 3 < 4")
        'water\\_near \\| 3 \\< 4'
    """
    return _SPECIAL.sub(r"\\\1", " ".join(text.split()))


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of Markdown.

    Examples:
        >>> print(markdown_table(("task", "runs"), [("near", "10")]))
        | task | runs |
        |---|---|
        | near | 10 |
    """
    lines = [" | ".join(map(plain, cells)) for cells in (columns, *rows)]
    head, *body = [f"| {line} |" for line in lines]
    return "\n".join([head, "|" + "---|" * len(columns), *body])


def _write(path: Path, text: str) -> None:
    with written_aside(path) as aside:
        aside.write_text(text, encoding="utf-8")
