"""What a viewer of `/live` gets: one look a second, as plain data.

What is in a look comes from a source: a robot, a server or the folder of a run. How it is sent is in
`live_port` and in the server's `http_api`.
"""

import json
import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from threading import Lock
from typing import Any, Protocol

EVERY_S = 1.0  # between two looks: the page shows an outage within two of them
VIEWERS_MAX = 8  # pages that one port serves at the same time
KEPT_MAX = 1000  # tasks that a process keeps for the next viewer


@dataclass(frozen=True, slots=True)
class Look:
    """What is new since the last look of the same viewer, and how things are now.

    source: `robot`, `server` or `run`; the page shows what this source has.
    now_s: Unix time of the source.
    tasks: lines of the trace (docs/formats.md); with several robots, each with the name of its `robot`.
    events: lines of a run's `events.jsonl`, each with its Unix time `at_s`.
    sites: by name, how each site is now: the fields of its condition, and why it is `absent`, or null.
    budget: what may still be spent; None if it is unknown.
    server: the state of a server; None for the others.
    left_out: tasks since the last look that are not among `tasks`, because there were too many.
    over: nothing will be added any more.
    """

    source: str
    now_s: float
    tasks: Sequence[Mapping[str, Any]] = ()
    events: Sequence[Mapping[str, Any]] = ()
    sites: Mapping[str, Mapping[str, Any]] | None = None
    budget: Mapping[str, float | None] | None = None
    server: Mapping[str, Any] | None = None
    left_out: int = 0
    over: bool = False


class Source(Protocol):
    """Whatever can be looked at."""

    def looks(self) -> Generator[Look]:
        """The looks of one viewer, without an end. The caller asks for the next one when it is due.

        Until it is asked, nothing is done: a source that nobody looks at costs nothing.
        """


class Viewers:
    """Counts the viewers of one port. Any thread may call this."""

    REFUSAL = f"{VIEWERS_MAX} pages are open, which is the most; close one of them\n"

    def __init__(self) -> None:
        self._lock = Lock()
        self._count = 0

    @property
    def full(self) -> bool:
        return self._count >= VIEWERS_MAX

    @contextmanager
    def one(self, looks: Generator[Look]) -> Iterator[None]:
        """One more viewer until the end, when its looks are closed."""
        with self._lock:
            self._count += 1
        try:
            yield
        finally:
            looks.close()
            with self._lock:
                self._count -= 1


_FIELDS = tuple(one.name for one in fields(Look))


def encode(look: Look) -> bytes:
    """The look as a server-sent event."""
    values = {name: getattr(look, name) for name in _FIELDS}
    try:
        text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    except ValueError:  # JSON has no infinity
        text = json.dumps(_finite(values), separators=(",", ":"), allow_nan=False)
    return f"data: {text}\n\n".encode()


def _finite(value: Any) -> Any:
    """The same value with None in place of each number that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return value
