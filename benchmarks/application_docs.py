"""Copies measured tables and pictures into the documentation; nothing is copied by hand.

`applications` measures them.
"""

import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from offboard.common.errors import ConfigError
from offboard.loadgen.table.measured_rows import write_whole

ROOT = Path(__file__).parents[1]
PAGE, PICTURES = Path("docs/applications.md"), Path("docs/pictures")


def publish(names: Sequence[str], out: Path, root: Path = ROOT) -> None:
    """Put the table of each application between its marks on the page, and its picture next to the page."""
    page = (root / PAGE).read_text()
    for name in names:
        for path in (out / f"{name}.md", out / f"{name}.svg"):
            if not path.is_file():
                raise ConfigError(f"--publish: {path} is missing: measure {name} first")
        page = _replaced(page, name, (out / f"{name}.md").read_text())
    write_whole(root / PAGE, page)
    (root / PICTURES).mkdir(exist_ok=True)
    for name in names:
        shutil.copyfile(out / f"{name}.svg", root / PICTURES / f"{name}.svg")


def _replaced(page: str, name: str, text: str) -> str:
    begin, end = f"<!-- table: {name} -->", "<!-- end of table -->"
    marked = re.compile(f"({re.escape(begin)}\n).*?(?={re.escape(end)})", re.DOTALL)
    if not marked.search(page):
        raise ConfigError(f"--publish: {PAGE} has no lines {begin} and {end}")
    shown = f"![Response time of each task, onboard and in the cloud]({PICTURES.name}/{name}.svg)"
    return marked.sub(lambda found: f"{found[1]}\n{shown}\n\n{text}\n", page, count=1)
