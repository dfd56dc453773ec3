"""The progress of long work, on a real pseudo terminal and on a pipe."""

import io
import logging
import re
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import TextIO

import pytest

from offboard.loadgen.progress import progress
from tests.terminals import COLUMNS, Terminal, plain_lines

STEPS = 4


Open = Callable[[], Terminal]


@pytest.fixture
def open_terminal(monkeypatch: pytest.MonkeyPatch) -> Open:
    """Opens a terminal, which becomes stdout, too."""

    def opened() -> Terminal:
        monkeypatch.setenv("TERM", "xterm-256color")
        for name in ("COLUMNS", "NO_COLOR"):
            monkeypatch.delenv(name, raising=False)
        found = Terminal()
        monkeypatch.setattr(sys, "stdout", found.file)
        return found

    return opened


def work(to: TextIO | None, *, every: int | None = None) -> None:
    with progress("plans", STEPS, to=to, every=every) as shown:
        for n in range(STEPS):
            time.sleep(0.3)
            shown.step(partial("plan {} took long [because] {}".format, n, "x" * 200))


def test_a_terminal_shows_a_bar_with_the_remaining_time(open_terminal: Open) -> None:
    """The bar has the number of steps, the remaining time and the last step, in one line of the terminal."""
    terminal = open_terminal()
    work(terminal.file)
    lines = plain_lines(terminal.close())
    assert any("━" in line and "plans" in line for line in lines)
    shown = re.compile(r"[123]/4 0:00:0\d left plan [012] took long \[because\] x")
    assert any(map(shown.search, lines)), lines
    assert max(map(len, lines)) <= COLUMNS


def test_the_bar_is_gone_at_the_end(open_terminal: Open) -> None:
    """What is printed after the work is all that stays; the cursor is shown again."""
    terminal = open_terminal()
    work(terminal.file)
    print("done")
    text = terminal.close()
    assert text.rpartition("\x1b[2K")[2].strip() == "done"
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")


def test_text_goes_above_the_bar(open_terminal: Open) -> None:
    """A line that is printed during the work is whole."""
    terminal = open_terminal()
    with progress("plans", STEPS, to=terminal.file):
        print("robot has begun its tasks")
    assert "robot has begun its tasks" in plain_lines(terminal.close())


def test_a_log_line_goes_above_the_bar(open_terminal: Open, monkeypatch: pytest.MonkeyPatch) -> None:
    """A handler that was made before the bar writes a whole line, and has its own stream afterwards."""
    terminal = open_terminal()
    monkeypatch.setattr(sys, "stderr", terminal.file)
    handler = logging.StreamHandler()
    monkeypatch.setattr(logging.getLogger(), "handlers", [handler])
    with progress("plans", STEPS, to=terminal.file):
        logging.getLogger("robot").warning("the cloud is silent")
    assert handler.stream is terminal.file
    assert "the cloud is silent" in plain_lines(terminal.close())


def test_an_inner_part_of_the_work_shows_no_second_bar(open_terminal: Open) -> None:
    """Two bars would overwrite each other."""
    terminal = open_terminal()
    with progress("runs", 2, to=sys.stdout), progress("bootstrap", 3, to=sys.stdout, every=1) as inner:
        inner.step()
    text = terminal.close()
    assert "runs" in text
    assert "bootstrap" not in text


def test_the_next_part_of_the_work_begins_at_zero(open_terminal: Open) -> None:
    """`begin` replaces the bar of a part whose end was not known."""
    terminal = open_terminal()
    with progress("starting", to=terminal.file) as shown:
        time.sleep(0.6)
        shown.begin("tasks", 7)
        shown.to(3)
        time.sleep(0.6)
    lines = plain_lines(terminal.close())
    assert any("starting" in line and "so far" in line for line in lines)
    assert any("tasks" in line and "3/7" in line for line in lines)


def test_a_pipe_gets_plain_lines() -> None:
    """One line after every second step and after the last one, and no escape code."""
    stream = io.StringIO()
    with progress("plans", 5, to=stream, every=2) as shown:
        for n in range(5):
            shown.step(partial("plan {}".format, n))
    assert stream.getvalue() == "2/5 plan 1\n4/5 plan 3\n5/5 plan 4\n"


def test_a_pipe_gets_nothing_unless_lines_are_wanted() -> None:
    """Commands that were silent on a pipe stay silent."""
    stream = io.StringIO()
    work(stream)
    assert stream.getvalue() == ""


@pytest.mark.parametrize("missing", ["rich", "TERM"])
def test_a_terminal_without_rich_or_a_cursor_gets_plain_lines(
    open_terminal: Open, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    """A robot has no rich, and a dumb terminal cannot overwrite a line."""
    terminal = open_terminal()
    if missing == "rich":
        for name in [name for name in sys.modules if name.partition(".")[0] == "rich"]:
            monkeypatch.delitem(sys.modules, name)
        for name in ("rich", "rich.console"):
            monkeypatch.setitem(sys.modules, name, None)
    else:
        monkeypatch.setenv("TERM", "dumb")
    with progress("plans", 1, to=terminal.file, every=1) as shown:
        shown.step(lambda: "plan 0")
    assert terminal.close() == "1/1 plan 0\r\n"
