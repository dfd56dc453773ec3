"""What a new user sees first: `make demo`, and install commands that work."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from offboard.common.errors import MissingExtra
from offboard.common.toml_file import read_toml
from tests.extras import needs

ROOT = Path(__file__).parents[2]
INSTALL = re.compile(r"pip install[^\n`]*?'([^'\n]*)\[([a-z0-9,-]+)\]'")
PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md"]


@pytest.mark.skipif(shutil.which("make") is None, reason="no make; remedy: apt-get install make")
@pytest.mark.parametrize("target", ["demo", "unit"])
def test_make_says_that_it_installs_before_it_does(target: str) -> None:
    """An install prints nothing for about a minute, so the line comes first."""
    command = ["make", "--dry-run", "--always-make", target]
    own = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MFLAGS")}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, env=own)
    lines = done.stdout.splitlines()
    said = next(number for number, line in enumerate(lines) if "installing into .venv, once" in line)
    assert said < next(number for number, line in enumerate(lines) if "pip install" in line)


def test_a_missing_extra_names_a_command_for_a_checkout() -> None:
    """Offboard is on no package index, so its name cannot be installed."""
    assert str(MissingExtra("loadgen report", "report")) == needs("loadgen report", "report")
    assert "pip install '.[report]'" in needs("loadgen report", "report")


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_each_install_command_of_a_page_is_for_a_checkout(page: Path) -> None:
    """It installs `.` with extras that pyproject.toml has, or a package of somebody else."""
    extras = read_toml(ROOT / "pyproject.toml")["project"]["optional-dependencies"]
    for what, names in INSTALL.findall(page.read_text()):
        assert what != "offboard", f"pip install 'offboard[{names}]'"
        assert what != "." or {*names.split(",")} <= extras.keys()
