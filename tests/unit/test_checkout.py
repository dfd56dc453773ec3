"""How a checkout is laid out: `offboard` holds all packages, for Python and for tools that read it."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("common", "robot_client", "cloud_server", "loadgen")


@pytest.mark.parametrize("package", PACKAGES)
def test_a_link_leads_to_each_package(package: str) -> None:
    """Tools find `offboard.common` in `offboard/common`, and so on."""
    assert (ROOT / "offboard" / package / "__init__.py").samefile(ROOT / package / "__init__.py")


def test_a_copy_without_links_works(tmp_path: Path) -> None:
    """Some programs unpack the links of a zip download as text files."""
    shutil.copytree(ROOT / "offboard", tmp_path / "offboard", ignore=lambda *_: set(PACKAGES))
    for package in PACKAGES:
        (tmp_path / "offboard" / package).write_text(f"../{package}")
        (tmp_path / package).symlink_to(ROOT / package)
    script = "from offboard import Offloader; print(Offloader.__module__)"
    said = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=50
    )
    assert said.stdout == "offboard.robot_client.offloader\n"
