"""`loadgen watch`: the page `/live` of a run that goes on, or that has ended, from the files in its folder.

The page itself is in `common.live`; what is in the files is described in docs/formats.md.
"""

import json
import os
import re
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from enum import Enum, auto
from pathlib import Path
from typing import Any

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError, MissingExtra
from offboard.common.live.live_files import charts_file
from offboard.common.live.live_port import LivePort
from offboard.common.live.look import Look
from offboard.common.security.address import PORT_MAX
from offboard.loadgen.play.run_files import EVENTS, SUMMARY, TRACE
from offboard.loadgen.testbed.testbed import ROBOT

LINES_A_LOOK_MAX = 5000  # of each file
_TRACE = re.compile(r"trace(|-\d+)\.jsonl")


class Page(Enum):
    """Whether a run has a page, and whether a browser opens it."""

    NONE = auto()
    SERVED = auto()
    OPENED = auto()


@dataclass(frozen=True)
class WatchConfig:
    """Where the page is served."""

    port: int = setting(
        0, "port of the page on this computer; 0 picks a free one", minimum=0, maximum=PORT_MAX
    )

    def __post_init__(self) -> None:
        check(self)


def run_watch(folder: Path, config: WatchConfig) -> int:
    """Serve the page of a run until Ctrl-C."""
    if not folder.is_dir():
        raise ConfigError(f"DIR: {folder} is not a folder; give the folder of a run, such as out/run")
    charts_file()
    if not any(folder.glob(f"*{TRACE}")):
        print(f"{folder} holds no {TRACE} yet: the page is empty until a run writes one there")
    with watching(folder, print, port=config.port, page=Page.OPENED):
        print("Ctrl-C ends it", flush=True)
        threading.Event().wait()
    return 0


@contextmanager
def watching(folder: Path, say: Callable[[str], object], *, page: Page, port: int = 0) -> Iterator[None]:
    """Serve the page of a run until the end, and say where."""
    try:
        charts_file()
    except MissingExtra as missing:
        say(f"no live page: {missing}")
        yield
        return
    served = LivePort(f"127.0.0.1:{port}", "--port", source=RunLive(folder))
    address = f"{served.url}/live"
    say(f"live page: {address}")
    if page is Page.OPENED and _has_screen():
        webbrowser.open(address)
    try:
        yield
    finally:
        served.close()


def _has_screen() -> bool:
    """Without a screen, a browser in the terminal would take it over."""
    return sys.platform == "darwin" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys())


def recorded_look(path: Path, kind: str | None) -> Look:
    """All tasks of a kind and all events that are in a trace, or in the folder of a run, as one look."""
    tasks: list[Any] = []
    events: list[Any] = []
    for look in RunLive(path).looks():
        if not look.tasks and not look.events:
            break
        tasks += [task for task in look.tasks if kind in (None, task["kind"])]
        events += look.events
    return Look("report", 0.0, tasks, events, over=True)


class RunLive:
    """The source of the page of a run: follows the files in its folder. A single trace has only tasks."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def looks(self) -> Generator[Look]:
        files: dict[Path, GrowingFile] = {}
        events, began_s = GrowingFile(self._path / EVENTS), None
        while True:
            over = (self._path / SUMMARY).exists()  # before the files are read: it is written last
            for path in self._traces():
                files.setdefault(path, GrowingFile(path))
            tasks = [
                {**line, "robot": f"{ROBOT}{path.stem.removeprefix('trace')}"} if len(files) > 1 else line
                for path, file in files.items()
                for line in file.new_lines()
            ]
            if began_s is None and tasks:
                began_s = min(datetime.fromisoformat(line["started_at"]).timestamp() for line in tasks)
            happened = [] if began_s is None else [_at(line, began_s) for line in events.new_lines()]
            yield Look("run", time.time(), tasks, [one for one in happened if one], over=over and not tasks)

    def _traces(self) -> list[Path]:
        if self._path.is_file():
            return [self._path]
        return [path for path in sorted(self._path.glob("trace*.jsonl")) if _TRACE.fullmatch(path.name)]


def _at(event: dict[str, Any], began_s: float) -> dict[str, Any] | None:
    """The event with its Unix time; None if it did not happen."""
    happened_s = event.get("happened_s")
    return None if happened_s is None else {**event, "at_s": began_s + happened_s}


class GrowingFile:
    """Reads each whole line of a file of JSON lines once, also while it grows. A bad line is left out."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read = 0

    def new_lines(self) -> list[dict[str, Any]]:
        """At most LINES_A_LOOK_MAX lines. A file that became shorter is a new one."""
        try:
            with self._path.open("rb") as file:
                if file.seek(0, os.SEEK_END) < self._read:
                    self._read = 0
                file.seek(self._read)
                whole = [line for _, line in zip(range(LINES_A_LOOK_MAX), file, strict=False)]
        except OSError:
            return []
        if whole and not whole[-1].endswith(b"\n"):
            whole.pop()
        self._read += sum(map(len, whole))
        return [line for raw in whole if (line := _parsed(raw)) is not None]


def _parsed(raw: bytes) -> dict[str, Any] | None:
    try:
        line = json.loads(raw)
    except (ValueError, RecursionError):
        return None
    return line if isinstance(line, dict) else None
