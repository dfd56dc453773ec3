"""The pages: each link leads to a file and a heading, and the start page has five doors with three pages."""

import re
from pathlib import Path

import pytest

from tests.markdown_links import ROOT, anchor_of, broken_links, missing_pages, pages

DOORS = ("Library", "ROS 2", "Policies", "Test bench", "Operations")
MADE_UP = {
    "docs/figures/PAGE.md",
    "docs/figures/NAME.md",
    "docs/page.md",
    "docs/speed.md",
}  # by tests and explanations


@pytest.mark.parametrize("page", pages(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_link_of_a_page_leads_somewhere(page: Path) -> None:
    """On a git host, without building the site; `make docs` says the same of the site."""
    assert list(broken_links(page)) == []


def test_every_page_that_code_names_is_there() -> None:
    """Comments, docstrings and messages name pages of docs/."""
    assert [(path, name) for path, name in missing_pages() if name not in MADE_UP] == []


@pytest.mark.parametrize(
    ("link", "said"),
    [
        ("[a](gone.md)", "gone.md: there is no such file"),
        ("![a](/page.md)", "/page.md: there is no such file"),
        ("[a](#there), [b](#gone)", "#gone: there is no such heading"),
        ("[a](page.md#gone)", "page.md#gone: there is no such heading"),
    ],
)
def test_a_broken_link_is_found(tmp_path: Path, link: str, said: str) -> None:
    """A file or heading that is not there is named; code and other hosts do not count."""
    page = tmp_path / "page.md"
    page.write_text(
        f"# There\n\n{link} [c](https://example.org/gone#gone) `[d](gone)`\n\n```\n[e](gone)\n```\n"
    )
    assert list(broken_links(page)) == [said]


@pytest.mark.parametrize(
    ("heading", "anchor"),
    [
        ("A remote call", "a-remote-call"),
        ("Every predictor at 80:20", "every-predictor-at-8020"),
        ("Start, memory and size", "start-memory-and-size"),
        ("`__version__`", "__version__"),
        ("1. Times, p < 0.005", "1-times-p--0005"),
    ],
)
def test_an_anchor_is_that_of_a_git_host(heading: str, anchor: str) -> None:
    """Lower case, without punctuation, a dash for each space."""
    assert anchor_of(heading) == anchor


def test_each_door_has_three_pages() -> None:
    """The start page and the site have the same doors, with the same pages in the same order."""
    start = (ROOT / "docs/README.md").read_text(encoding="utf-8")
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \*\*(.+?)\*\* \|.*\| (.+) \|$", start, re.MULTILINE)
    doors = {door: re.findall(r"\]\(([\w.]+)\)", links) for door, links in rows}
    assert tuple(doors) == DOORS
    for door, linked in doors.items():
        section = re.search(rf"^  - {door}:\n((?:      - .*\n)+)", site, re.MULTILINE)
        assert section is not None
        assert re.findall(r": ([\w.]+)$", section[1], re.MULTILINE) == linked
        assert len(linked) == 3
