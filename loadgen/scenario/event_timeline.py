"""The timeline of a scenario: events that change a part or the link, at a time or at a task.

An event is data here; `play` decides when to look for due events and applies them to the testbed.
"""

import json
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError, DataError
from offboard.common.toml_file import line_of, unknown
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.testbed.cpu_quota import CPUS_MAX, CPUS_MIN
from offboard.loadgen.testbed.testbed import WAN, Testbed, kind_of

EVENTS_MAX = 10_000
AT_S_MAX = 86_400.0
AT_TASK_MAX = 1_000_000
HOGS_MAX = 16
WHEN = ("at_s", "at_task")
ON_A_PART = ("kill", "stop", "start", "restart", "pause", "resume", "cut", "join")
ACTIONS = ("link", "cpus", "hogs", "reset", *ON_A_PART)
ON = "on"  # names the server whose link an event changes
ON_A_LINK = ("link", "reset")
KEYS = (*WHEN, ON, *ACTIONS)


@dataclass(frozen=True, slots=True)
class Event:
    """One action, due `at_s` seconds after the first task was due, or once `at_task` tasks are answered.

    `value` depends on the action: the name of a part, {part: CPUs}, {part: number of hogs}, conditions as in
    PUT /link of the relay, or True.
    `on` is the server whose link changes; None: all links.
    """

    action: str
    value: Any
    at_s: float | None = None
    at_task: int | None = None
    on: str | None = None

    def shown(self) -> dict[str, Any]:
        when = {"at_s": self.at_s} if self.at_s is not None else {"at_task": self.at_task}
        where = {} if self.on is None else {ON: self.on}
        return {**when, **where, self.action: self.value}

    def in_words(self) -> str:
        """Such as `link outage = true`, `hogs cloud = 4` or `kill cloud`."""
        if isinstance(self.value, Mapping):
            said = " " + ", ".join(f"{name} = {json.dumps(one)}" for name, one in self.value.items())
        else:
            said = "" if self.value is True else f" {self.value}"
        return f"{self.action}{said}" + ("" if self.on is None else f" on {self.on}")

    def apply(self, testbed: Testbed) -> None:
        match self.action:
            case "link":
                testbed.set_link(self.on, **self.value)
            case "cpus":
                for part, cpus in self.value.items():
                    testbed.set_cpus(part, cpus)
            case "hogs":
                for part, count in self.value.items():
                    testbed.set_hogs(part, count)
            case "reset":
                testbed.reset(self.on)
            case "restart":
                testbed.kill(self.value)
                testbed.start(self.value)
            case action:
                getattr(testbed, action)(self.value)

    def parts(self) -> tuple[str, ...]:
        if self.action in ON_A_PART:
            return (self.value,)
        return tuple(self.value) if self.action in ("cpus", "hogs") else ()


_Numbered = tuple[int, Event]  # its place in the file


class Timeline:
    """Returns each event once, when it is due. Events that are due together keep the order of the file."""

    def __init__(self, events: Sequence[Event]) -> None:
        numbered = list(enumerate(events))
        self._timed = deque(sorted((one for one in numbered if one[1].at_s is not None), key=_when))
        self._counted = deque(sorted((one for one in numbered if one[1].at_s is None), key=_when))

    def due(self, elapsed_s: float, answered: int) -> list[Event]:
        """The events that are due now and were not returned before."""
        due: list[_Numbered] = []
        for queue, now in ((self._timed, elapsed_s), (self._counted, answered)):
            while queue and _when(queue[0]) <= now:
                due.append(queue.popleft())
        return _in_order(due)

    def left(self) -> Sequence[Event]:
        return tuple(_in_order([*self._timed, *self._counted]))


def absent_at_first(events: Sequence[Event]) -> set[str]:
    """The parts whose first event starts them, so that they do not run from the beginning."""
    first: dict[str, str] = {}
    for event in events:
        for part in event.parts():
            first.setdefault(part, event.action)
    return {part for part, action in first.items() if action == "start"}


def parse_events(
    table: Mapping[str, Any], path: Path, *, parts: Sequence[str], links: Mapping[str, Link]
) -> tuple[Event, ...]:
    """The events of a scenario file, in its order; DataError names file and line.

    `parts` are the names that events may use, `links` are the links that they change, by server.
    """
    lines = path.read_text().splitlines()
    events = []
    for number, event in enumerate(list_of_tables(table, "event", path, most=EVENTS_MAX), 1):
        try:
            events.append(_parse(event, parts, links))
        except ConfigError as error:
            key, _, said = str(error).partition(": ")
            place = f"{path}:{line_of(lines, 'event', number, key)}"
            raise DataError(f"{place}: {key}: {said}" if key in KEYS else f"{place}: {said}") from None
    return tuple(events)


def list_of_tables(table: Mapping[str, Any], name: str, path: Path, *, most: int) -> list[dict[str, Any]]:
    """The tables under each [[name]] of a scenario file."""
    given = table.get(name, [])
    if not isinstance(given, list) or not all(isinstance(one, dict) for one in given):
        raise DataError(f"{path}: {name} is not a list of tables, each under [[{name}]]")
    if len(given) > most:
        raise DataError(f"{path}: {len(given)} {name}s, at most {most} are allowed")
    return given


def _parse(given: Mapping[str, Any], parts: Sequence[str], links: Mapping[str, Link]) -> Event:
    """One event; the text of a ConfigError starts with the key."""
    for key in given:
        if key not in KEYS:
            raise ConfigError(f"{key}: {unknown('event or key', key, KEYS)}")
    actions = [key for key in given if key in ACTIONS]
    if len(actions) != 1:
        what = f"{' and '.join(actions)} in one event" if actions else "an event without an action"
        raise ConfigError(f"event: {what}; give one of {', '.join(ACTIONS)}")
    whens = [key for key in given if key in WHEN]
    if len(whens) != 1:
        raise ConfigError(f"event: give either at_s or at_task, not {' and '.join(whens) or 'none'}")
    number = _number(whens[0], given[whens[0]], 0, AT_S_MAX if whens[0] == "at_s" else AT_TASK_MAX)
    if whens[0] == "at_task" and number != int(number):
        raise ConfigError(f"at_task: {number} is not a whole number")
    on = _on(given, actions[0], links)
    changed = list(links.values()) if on is None else [links[on]]
    value = _value(actions[0], given[actions[0]], parts, changed)
    if whens[0] == "at_s":
        return Event(actions[0], value, at_s=number, on=on)
    return Event(actions[0], value, at_task=int(number), on=on)


def _on(given: Mapping[str, Any], action: str, links: Mapping[str, Link]) -> str | None:
    """The server whose link an event changes; None: all of them."""
    on = given.get(ON)
    if on is None:
        return None
    if action not in ON_A_LINK:
        raise ConfigError(f"{ON}: only an event with {' or '.join(ON_A_LINK)} can be on one link")
    if on not in links:
        raise ConfigError(f"{ON}: {on!r} is not one of {', '.join(links)}")
    return str(on)


def _value(action: str, value: Any, parts: Sequence[str], links: Sequence[Link]) -> Any:
    if action in ON_A_PART:
        return _part(action, value, parts)
    if action == "reset":
        if value is not True:
            raise ConfigError(f"reset: {value!r} is not true")
        return True
    if not isinstance(value, dict) or not value:
        raise ConfigError(f"{action}: {value!r} is not a table, or is empty")
    if action == "link":
        try:
            for link in links:
                link.changed(value)
        except ConfigError as error:
            raise ConfigError(f"link: {error}") from None
        return value
    return _number_by_part(action, value, parts)


def _number_by_part(action: str, value: Mapping[str, Any], parts: Sequence[str]) -> Mapping[str, float]:
    """{part: CPUs} or {part: number of hogs}."""
    low, high = (CPUS_MIN, CPUS_MAX) if action == "cpus" else (0, HOGS_MAX)
    named = {_part(action, part, parts): _number(action, number, low, high) for part, number in value.items()}
    if any(kind_of(part) == WAN for part in named):
        raise ConfigError(f"{action}: the relay has no CPU quota")
    if action == "cpus":
        return named
    if any(number != int(number) for number in named.values()):
        raise ConfigError(f"hogs: {value!r}: not whole numbers")
    return {part: int(number) for part, number in named.items()}


def _part(action: str, name: Any, parts: Sequence[str]) -> str:
    if name not in parts:
        raise ConfigError(f"{action}: {name!r} is not one of {', '.join(parts)}")
    return str(name)


def _number(key: str, value: Any, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ConfigError(f"{key}: {value!r} is not a number from {low:g} to {high:g}")
    return float(value)


def _when(numbered: _Numbered) -> float:
    """When an event is due: seconds, or answered tasks."""
    _, event = numbered
    when = event.at_task if event.at_s is None else event.at_s
    assert when is not None, "checked when the file was read"
    return when


def _in_order(numbered: list[_Numbered]) -> list[Event]:
    return [event for _, event in sorted(numbered, key=itemgetter(0))]
