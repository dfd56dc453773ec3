"""What the built site needs beyond the plain pages; mkdocs calls these functions.

- Pages of the checkout outside of docs/ (`PROJECT`) become pages of the site.
- Links to them follow. A link to any other file of the checkout becomes its name, as code.
- docs/api.md gets the whole docstrings.
- A page that loads anything from another host is a warning, which ends a strict build.
- A list that follows a line of text gets the blank line that it needs there, and not on a git host.
"""

import os.path
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
DOCS = "docs"
PROJECT = (
    *("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md", "maps/README.md"),
    *("loadgen/links/SOURCE.md", "loadgen/datasets/README.md"),
)
FOLDER = "project"  # of the site, for them
FENCE = re.compile(r"(^ *```.*?^ *```[^\n]*$)", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"(!?)\[([^\]\n]*)\]\(([^)\s]+)\)")
ELSEWHERE = re.compile(r"[a-z][a-z0-9+.-]*:|#", re.IGNORECASE)
NAME = re.compile(r"<!-- api: ([\w.]+) -->\n.*?<!-- end -->", re.DOTALL)
LOADED = re.compile(
    r"<(?:script|img|iframe|source|video|audio|embed)\b[^>]*\bsrc=[\"']?(?:https?:)?//[^\s\"'>]+"
    r"|<link\b(?=[^>]*rel=[\"']?(?:stylesheet|icon|preload|preconnect|manifest))[^>]*href=[\"']?(?:https?:)?//[^\s\"'>]+",
    re.IGNORECASE,
)
LIST = re.compile(r"^(?! *(?:[-*]|\d+\.) )(?!\s|#|\||<!--)(.+)\n(?=(?:[-*]|\d+\.) )", re.MULTILINE)

log = get_plugin_logger("offboard")


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages of the checkout."""
    for name in PROJECT:
        files.append(File.generated(config, f"{FOLDER}/{name}", abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """The page as the site needs it."""
    there = page.file.src_uri
    source = there.removeprefix(f"{FOLDER}/") if there.startswith(f"{FOLDER}/") else f"{DOCS}/{there}"
    if source == f"{DOCS}/api.md":
        markdown = NAME.sub(r"::: offboard.\1", markdown)
    parts = FENCE.split(markdown)  # text and code in turn
    parts[::2] = [_with_links(LIST.sub(r"\1\n\n", part), source, there) for part in parts[::2]]
    return "".join(parts)


def on_post_page(output: str, *, page: Page, **_: Any) -> str:
    """The same page; it must load nothing from other hosts."""
    for loaded in LOADED.findall(output):
        log.warning("%s loads from another host: %s", page.file.src_uri, loaded)
    return output


def _with_links(text: str, source: str, there: str) -> str:
    """The text of the page `source` of the checkout with the links that it needs at `there` in the site."""

    def link(found: "re.Match[str]") -> str:
        mark, shown, target = found.groups()
        if ELSEWHERE.match(target):
            return found[0]
        name, sharp, anchor = target.partition("#")
        path = os.path.normpath(os.path.join(os.path.dirname(source), name))  # noqa: PTH118, PTH120
        if path.startswith(f"{DOCS}/"):
            path = path.removeprefix(f"{DOCS}/")
        elif path in PROJECT:
            path = f"{FOLDER}/{path}"
        elif (ROOT / path).exists():
            return shown if shown.startswith("`") else f"{shown} (`{path}`)"
        else:
            log.warning("%s: %s is not in the checkout", source, target)
            return found[0]
        return f"{mark}[{shown}]({os.path.relpath(path, os.path.dirname(there))}{sharp}{anchor})"  # noqa: PTH120

    return LINK.sub(link, text)
