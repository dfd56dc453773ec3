"""The links of the Markdown pages, as a git host shows them: files and anchors that are not there.

`make docs` finds the same in the built site; this needs no other software. `unit/test_links.py` uses it.
"""

import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from urllib.parse import unquote

ROOT = Path(__file__).parents[1]
FENCE = re.compile(r"^( *)(```+|~~~+).*?^\1\2[^\n]*$", re.DOTALL | re.MULTILINE)
CODE = re.compile(r"`[^`\n]*`")
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
LINK = re.compile(r"\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)")
HEADING = re.compile(r"^#{1,6} +(.+?) *#* *$", re.MULTILINE)
HTML_ANCHOR = re.compile(r"<a (?:id|name)=\"([^\"]+)\"")
OUTSIDE = re.compile(r"[a-z][a-z0-9+.-]*:", re.IGNORECASE)  # https:, mailto:
NAMED = re.compile(r"(?<![\w/.-])docs/(?:[\w-]+/)*[\w-]+\.md\b")
HISTORY = "CHANGELOG.md"  # it may name pages that are gone
FOLDERS = (
    "benchmarks",
    "cloud_server",
    "common",
    "deploy",
    "examples",
    "loadgen",
    "offboard",
    "robot_client",
    "tests",
)
ENDINGS = {".py", ".toml", ".yaml", ".yml", ".service", ".sh", ".md"}


def pages(root: Path = ROOT) -> list[Path]:
    """The pages of the checkout."""
    nested = (
        path for name in ("docs", "loadgen", "maps", "examples") for path in (root / name).rglob("*.md")
    )
    return sorted([*root.glob("*.md"), *nested])


def broken_links(page: Path) -> Iterator[str]:
    """What is wrong with the links of a page."""
    text = page.read_text(encoding="utf-8")
    for found in LINK.finditer(COMMENT.sub("", CODE.sub("", FENCE.sub("", text)))):
        target = found[1]
        if OUTSIDE.match(target):
            continue
        name, _, anchor = unquote(target).partition("#")
        path = page.parent / name if name else page
        if name.startswith("/") or not path.exists():
            yield f"{target}: there is no such file"
        elif anchor and anchor not in anchors(path.resolve()):
            yield f"{target}: there is no such heading"


@cache
def anchors(page: Path) -> frozenset[str]:
    """The anchors of a page as GitHub makes them; of equal headings, only the first one can be linked to."""
    if page.suffix != ".md":
        return frozenset()
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    return frozenset([*map(anchor_of, HEADING.findall(text)), *HTML_ANCHOR.findall(text)])


def anchor_of(heading: str) -> str:
    shown = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
    return re.sub(r"[^\w\- ]", "", shown.lower()).replace(" ", "-")


def missing_pages(root: Path = ROOT) -> Iterator[tuple[Path, str]]:
    """Pages of docs/ that code, comments or messages name and that are not there, each with the file."""
    top = [path for path in root.iterdir() if path.is_file()]
    for path in sorted([*top, *(one for name in FOLDERS for one in (root / name).rglob("*"))]):
        if path.name != HISTORY and (path.suffix in ENDINGS or path in top) and path.is_file():
            for name in NAMED.findall(path.read_text(encoding="utf-8", errors="replace")):
                if not (root / name).is_file():
                    yield path.relative_to(root), name


if __name__ == "__main__":
    found = [f"{page.relative_to(ROOT)}: {one}" for page in pages() for one in broken_links(page)]
    print("\n".join(found))
    sys.exit(bool(found))
