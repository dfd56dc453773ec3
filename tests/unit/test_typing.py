"""The types that a user's type checker sees."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAM = re.compile(r"```python\n# (\w+\.py)\n(.*?)```", re.DOTALL)

pytestmark = pytest.mark.timeout(240)  # mypy reads numpy and the library, once; later runs use its cache


def check(*files: Path, folder: Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [
            sys.executable,
            *("-m", "mypy", "--strict", "--follow-imports=silent"),
            *("--config-file", ROOT / "pyproject.toml", "--cache-dir", ROOT / ".cache/mypy-calls"),
            *files,
        ],
        capture_output=True,
        text=True,
        timeout=200,
        cwd=folder,
        env=os.environ | {"MYPYPATH": f"{ROOT}:{folder}"},
    )


def test_a_call_has_the_type_of_its_task(tmp_path: Path) -> None:
    """A call, a batch and a coroutine return what the function returns, also for a task with a setup."""
    done = check(ROOT / "tests/typed_calls.py", folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_wrong_arguments_are_found(tmp_path: Path) -> None:
    """Each of ten calls with wrong arguments is one error."""
    done = check(ROOT / "tests/wrong_calls.py", folder=tmp_path)
    lines = (ROOT / "tests/wrong_calls.py").read_text().splitlines()
    wrong = [number for number, line in enumerate(lines, 1) if line.startswith("    ")]
    found = [int(number) for number in re.findall(r"wrong_calls\.py:(\d+): error", done.stdout)]
    assert found == wrong, done.stdout + done.stderr
    assert len(wrong) == 10


@pytest.mark.parametrize("page", ["README.md", "docs/own_task.md", "docs/offload.md"])
def test_the_programs_of_a_page_are_typed(tmp_path: Path, page: str) -> None:
    """`mypy --strict` finds nothing in the programs that users copy."""
    programs = PROGRAM.findall((ROOT / page).read_text())
    assert programs
    for name, text in programs:
        (tmp_path / name).write_text(text)
    done = check(*sorted(tmp_path.glob("*.py")), folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
