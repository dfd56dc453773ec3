"""`loadgen` in a real pseudo terminal of 100 columns, and piped."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.terminals import COLUMNS, plain_lines, run_in_terminal

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]

ROOT = Path(__file__).parents[2]
RUN = ["run", "demo", "--tasks", "24", "--measure", "both"]
SIMULATE = ["compare", "calm", "--simulate", "--seeds", "8", "--tasks", "60", "--jobs", "1"]


def loadgen(*args: str | Path) -> list[str]:
    return [sys.executable, "-m", "offboard.loadgen", *map(str, args)]


def table_lines(lines: list[str]) -> list[str]:
    return [line for line in lines if line.startswith("|")]


def test_a_run_shows_bar_remaining_time_and_table(tmp_path: Path) -> None:
    """The bar counts the tasks and says the remaining time; the table at the end fits in 100 columns."""
    code, text, _ = run_in_terminal(loadgen(*RUN, "--out", tmp_path), ROOT, timeout_s=150)
    assert code == 0, text
    lines = plain_lines(text)
    assert any("━" in line and re.search(r"tasks .* \d+/24 \d:\d\d:\d\d left", line) for line in lines), text
    heading, rule, robot = table_lines(lines)
    assert heading.split()[1] == "robot"
    assert set(rule) == set("|-: ")
    assert robot.split("|")[2].strip() == "24"
    assert max(map(len, table_lines(lines))) <= COLUMNS
    assert any(line.startswith("24 tasks answered") for line in lines)
    assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")


def test_a_piped_run_is_plain(tmp_path: Path) -> None:
    """There are plain lines, without any escape code or carriage return."""
    command = loadgen(*RUN, "--out", tmp_path)
    done = subprocess.run(command, capture_output=True, timeout=150, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert not re.search(rb"[\x1b\r]", done.stdout + done.stderr)
    lines = done.stdout.decode().splitlines()
    assert [line.split()[0] for line in lines if re.match(r"\d+/24 ", line)] == ["10/24", "20/24", "24/24"]
    assert max(map(len, table_lines(lines))) <= COLUMNS


def test_a_table_that_is_piped_is_plain_although_stderr_is_a_terminal() -> None:
    """`loadgen compare > table.md` shows the bar on the terminal, and the file holds the table alone."""
    code, shown, piped = run_in_terminal(loadgen(*SIMULATE), ROOT, timeout_s=150, stdout=subprocess.PIPE)
    assert code == 0, shown
    assert any("━" in line and "simulating" in line for line in plain_lines(shown)), shown
    assert "\x1b" not in piped
    assert piped.startswith("Scenario calm in simulation")
    assert max(map(len, piped.splitlines())) <= COLUMNS
