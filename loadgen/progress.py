"""The progress of long work: a bar with the remaining time on a terminal, plain lines elsewhere.

This is the only file that imports rich. Without rich, a terminal gets the plain lines, too.
"""

import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol, TextIO

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress

REFRESHES_A_SECOND = 2
BAR_COLUMNS = 20

About = Callable[[], str]


class Progress(Protocol):
    """How far some work is. Any thread may call the methods."""

    def begin(self, what: str, total: int | None) -> None:
        """Go on with the next part of the work; its steps are counted from 0. None: unknown."""

    def to(self, done: int, about: About | None = None) -> None:
        """So many steps of this part are done; `about` tells something about the last one."""

    def step(self, about: About | None = None) -> None:
        """One more step is done."""


def drawn_on(stream: TextIO) -> bool:
    """Whether a bar can be drawn here: on a terminal that can move its cursor."""
    return stream.isatty() and os.environ.get("TERM", "dumb") not in ("dumb", "unknown")


@contextmanager
def progress(
    what: str, total: int | None = None, *, to: TextIO | None = None, every: int | None = None
) -> Iterator[Progress]:
    """The progress of the work in the `with` block, on the stream `to` (default: stderr).

    A terminal shows a bar until the block ends. Text that is printed meanwhile goes above the bar. Elsewhere
    a line is printed every `every` steps, and after the last one; None: no line. A block inside such a block
    shows nothing.
    """
    stream = sys.stderr if to is None else to
    if hasattr(stream, "rich_proxied_file"):  # a bar is drawn already, and has replaced the stream
        yield _Lines(what, total, stream, None)
        return
    drawn = _drawing(stream) if drawn_on(stream) else None
    if drawn is None:
        yield _Lines(what, total, stream, every)
        return
    stderr = sys.stderr
    with drawn, _logged_to(sys.stderr, instead_of=stderr):
        yield _Bar(drawn, what, total)


class _Lines:
    """Prints `DONE/TOTAL ABOUT` after every so many steps; None: never."""

    def __init__(self, what: str, total: int | None, stream: TextIO, every: int | None) -> None:
        self._stream, self._every = stream, every
        self.begin(what, total)

    def begin(self, what: str, total: int | None) -> None:
        self._what, self._total, self._done = what, total, 0

    def to(self, done: int, about: About | None = None) -> None:
        self._done = done
        if self._every is not None and (done % self._every == 0 or done == self._total):
            print(f"{done}/{self._total} {about() if about else self._what}", file=self._stream, flush=True)

    def step(self, about: About | None = None) -> None:
        self.to(self._done + 1, about)


class _Bar:
    """Draws the part of the work that goes on now."""

    def __init__(self, drawn: "RichProgress", what: str, total: int | None) -> None:
        self._drawn = drawn
        self._task = drawn.add_task(what, total=total, about="")

    def begin(self, what: str, total: int | None) -> None:
        self._drawn.remove_task(self._task)
        self._task = self._drawn.add_task(what, total=total, about="")

    def to(self, done: int, about: About | None = None) -> None:
        self._drawn.update(self._task, completed=done, about=about() if about else "")

    def step(self, about: About | None = None) -> None:
        self._drawn.update(self._task, advance=1, about=about() if about else "")


@contextmanager
def _logged_to(stream: TextIO, *, instead_of: TextIO) -> Iterator[None]:
    """Let log lines go above the bar, too: a handler keeps the stream that it was made with."""
    handlers = [one for one in logging.getLogger().handlers if isinstance(one, logging.StreamHandler)]
    moved = [one for one in handlers if one.stream is instead_of]
    for handler in moved:
        handler.setStream(stream)
    try:
        yield
    finally:
        for handler in moved:
            handler.setStream(instead_of)


def _drawing(stream: TextIO) -> "RichProgress | None":
    """What draws on a terminal; None if rich is not installed."""
    try:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn
        from rich.progress import Task as RichTask
        from rich.table import Column
        from rich.text import Text
    except ImportError:
        return None

    class Count(ProgressColumn):
        """DONE/TOTAL; nothing while the total is unknown."""

        def render(self, task: RichTask) -> Text:
            return Text("" if task.total is None else f"{task.completed:.0f}/{task.total:.0f}")

    class Time(ProgressColumn):
        """The remaining time; the time so far until the speed is known."""

        def render(self, task: RichTask) -> Text:
            remaining = None if task.total is None else task.time_remaining
            return Text(
                f"{_clock(task.elapsed)} so far" if remaining is None else f"{_clock(remaining)} left"
            )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(BAR_COLUMNS),
        Count(),
        Time(),
        TextColumn(
            "{task.fields[about]}",
            markup=False,
            table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1),
        ),
    )
    return Progress(
        *columns,
        console=Console(file=stream),
        refresh_per_second=REFRESHES_A_SECOND,
        expand=True,
        transient=True,
        redirect_stdout=sys.stdout.isatty(),  # else what is piped would go to the terminal
        redirect_stderr=sys.stderr.isatty(),
    )


def _clock(seconds: float | None) -> str:
    minutes, whole = divmod(round(seconds or 0.0), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{whole:02}"
