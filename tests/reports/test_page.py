"""The page of a study: all of it is there, and nothing else is needed to read it."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest

from gdrl_torchrl.reports.of_study import read_study
from gdrl_torchrl.reports.report import write_report


class Page(HTMLParser):
    """Ids, what is linked to, and what is loaded."""

    def __init__(self, text):
        super().__init__()
        self.ids, self.links, self.loaded, self.tags, self.texts = [], [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.tags.append((tag, given))
        if "id" in given:
            self.ids.append(given["id"])
        for name in ("href", "xlink:href"):
            if name in given:
                self.links.append(given[name])
        self.loaded += [given[name] for name in ("src", "srcset", "data") if name in given]
        for value in given.values():
            self.links += re.findall(r"url\((#[^)]*)\)", value or "")

    def handle_data(self, data):
        self.texts.append(data)


@pytest.fixture(scope="module")
def folder(study, tmp_path_factory):
    out = tmp_path_factory.mktemp("page")
    write_report(read_study(study), out)
    return out


@pytest.fixture(scope="module")
def page(folder):
    return Page((folder / "report.html").read_text())


def test_ids_are_unique_and_every_link_leads_to_one(page):
    assert len(set(page.ids)) == len(page.ids)
    assert page.links
    assert all(link.startswith("#") for link in page.links)
    assert {link[1:] for link in page.links} <= set(page.ids)


def test_the_page_loads_nothing_and_runs_nothing(page, folder):
    assert not page.loaded
    assert not {"script", "link", "iframe", "img"} & {tag for tag, _ in page.tags}
    # What begins with these is not a name of SVG's.
    text = re.sub(r'xmlns(:\w+)?="[^"]*"', "", (folder / "report.html").read_text())
    assert "http" not in text


def test_every_run_can_be_pointed_at_in_every_figure_of_seeds(folder, study):
    runs = 4 * 8 - 1
    shown = sum(
        (folder / "figures" / f"scores-{k}.svg").read_text().count("<title>")
        for k in (0, 1)
    )
    assert shown == runs
    svg = (folder / "figures" / "curves-0-total_steps.svg").read_text()
    titles = re.findall(r"<title>(.*?)</title>", svg)
    assert len(titles) == 15
    assert "gppo, seed 5" in " ".join(titles)
    dots = (folder / "figures" / "scores-0.svg").read_text()
    assert "ppo, seed 3: failed, counts as 0" in dots


def test_figures_stand_alone_and_the_markdown_shows_all_of_them(folder):
    shown = re.findall(r"!\[.+\]\((figures/.+\.svg)\)", (folder / "report.md").read_text())
    files = sorted(p.relative_to(folder).as_posix() for p in folder.glob("figures/*"))
    assert sorted(shown) == files
    for name in files:
        assert ElementTree.parse(folder / name).getroot().get("viewBox")


def test_the_question_is_text_whatever_is_in_it(page, folder):
    assert "Does <evolution> help & how much?" in page.texts
    assert "Does \\<evolution\\> help" in (folder / "report.md").read_text()


def test_the_same_results_give_the_same_page(folder, study, tmp_path):
    write_report(read_study(study), tmp_path)
    for path in folder.rglob("*"):
        if path.is_file():
            again = tmp_path / path.relative_to(folder)
            assert again.read_bytes() == path.read_bytes()
