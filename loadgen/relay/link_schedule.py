"""The link schedule: changes of the link at given times, read from TOML or JSON, checked, and played.

What a change does to bytes is left to the relay.
"""

import asyncio
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError, DataError
from offboard.common.toml_file import line_of, read_toml, unknown
from offboard.loadgen.relay.link.link import CONDITIONS, Link
from offboard.loadgen.relay.tcp.relay import Relay

EVENTS_MAX = 10_000
AT_S_MAX = 1e6
KEYS = ("at_s", "up", "down", "reset", *CONDITIONS)

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Event:
    """A change of the link, `at_s` seconds after the start of the schedule.

    `changes` are conditions as in PUT /link. With `reset` all connections are reset after the change.
    """

    at_s: float
    changes: Mapping[str, Any]
    reset: bool = False

    def shown(self) -> dict[str, Any]:
        """The event as the user wrote it."""
        return {"at_s": self.at_s, **self.changes} | ({"reset": True} if self.reset else {})


class Schedule:
    """Plays events on the link of a relay, in order of time; an event that is due is played at once."""

    def __init__(self, relay: Relay) -> None:
        self._relay = relay
        self._events: Sequence[Event] = ()
        self._done = 0
        self._start_s = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def start(self, events: Sequence[Event]) -> None:
        """Play these events from now on, and forget those left of an earlier schedule."""
        self.stop()
        self._events, self._done = events, 0
        self._start_s = asyncio.get_running_loop().time()
        self._play()

    def stop(self) -> None:
        """Forget the events that are left; the link stays as it is."""
        if self._timer is not None:
            self._timer.cancel()
        self._events, self._done = (), 0

    def status(self) -> dict[str, Any]:
        """Seconds since the start, number of events played, and all events in order."""
        now_s = asyncio.get_running_loop().time() - self._start_s if self._events else 0.0
        return {"now_s": now_s, "done": self._done, "event": [event.shown() for event in self._events]}

    def _play(self) -> None:
        loop = asyncio.get_running_loop()
        while self._done < len(self._events):
            event = self._events[self._done]
            if loop.time() < self._start_s + event.at_s:
                self._timer = loop.call_at(self._start_s + event.at_s, self._play)
                return
            self._done += 1
            self._apply(event)

    def _apply(self, event: Event) -> None:
        try:
            if event.changes:
                self._relay.set_link(self._relay.link.changed(event.changes), by="schedule")
        except ConfigError as error:  # the link has changed since the schedule was checked
            log.warning("schedule: the event at %g s was skipped: %s; remedy: correct it", event.at_s, error)
        if event.reset:
            self._relay.reset()


def read_schedule(path: Path, link: Link) -> tuple[Event, ...]:
    """The events of a TOML file, in order of time, checked for this link; errors name file, line and key."""
    table = read_toml(path)
    lines = path.read_text().splitlines()
    try:
        return parse_schedule(
            table, link, lambda number, key: f"{path}:{line_of(lines, 'event', number, key)}"
        )
    except ConfigError as error:
        raise DataError(str(error)) from None


def parse_schedule(
    table: Mapping[str, Any],
    link: Link,
    place: Callable[[int, str], str] = lambda number, _key: f"event {number}" if number else "schedule",
) -> tuple[Event, ...]:
    """The events of `{"event": [{"at_s": 5, ...}, ...]}`, in order of time, checked for this link.

    `place` gives the text with which a ConfigError starts: where key `key` of event `number` is. Events are
    numbered from 1; number 0 is the schedule as a whole.
    """
    for key in table:
        if key != "event":
            raise ConfigError(f"{place(0, key)}: {unknown('key', key, ('event',))}")
    given = table.get("event", [])
    if not isinstance(given, list) or not all(isinstance(event, dict) for event in given):
        raise ConfigError(f"{place(0, 'event')}: event is not a list of tables")
    if len(given) > EVENTS_MAX:
        raise ConfigError(f"{place(0, 'event')}: {len(given)} events; at most {EVENTS_MAX} are allowed")
    numbered = [(_event(event, number, place), number) for number, event in enumerate(given, 1)]
    numbered.sort(key=lambda pair: pair[0].at_s)
    for event, number in numbered:
        try:
            link = link.changed(event.changes)
        except ConfigError as error:
            name = str(error).partition(":")[0].rpartition(".")[2]
            raise ConfigError(f"{place(number, name)}: {error}") from None
    return tuple(event for event, _number in numbered)


def _event(given: Mapping[str, Any], number: int, place: Callable[[int, str], str]) -> Event:
    for known, table in (
        (KEYS, given),
        (CONDITIONS, given.get("up", {})),
        (CONDITIONS, given.get("down", {})),
    ):
        if not isinstance(table, dict):
            key = "up" if table is given.get("up") else "down"
            raise ConfigError(f"{place(number, key)}: {key}: {table!r} is not a table")
        for key in table:
            if key not in known:
                raise ConfigError(f"{place(number, key)}: {unknown('key', key, known)}")
    at_s, reset = given.get("at_s"), given.get("reset", False)
    if not isinstance(at_s, int | float) or isinstance(at_s, bool) or not 0 <= at_s <= AT_S_MAX:
        wrong = "is missing" if at_s is None else f"{at_s!r} is not a number from 0 to {AT_S_MAX:g}"
        raise ConfigError(f"{place(number, 'at_s')}: at_s: {wrong}")
    if not isinstance(reset, bool):
        raise ConfigError(f"{place(number, 'reset')}: reset: {reset!r} is neither true nor false")
    changes = {name: value for name, value in given.items() if name not in ("at_s", "reset")}
    return Event(float(at_s), changes, reset)
