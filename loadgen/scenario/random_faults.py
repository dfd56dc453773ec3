"""Random faults for a scenario, drawn from its seed, so that the same seed gives the same faults.

They become events of the timeline; `play` applies them like any other event.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random
from typing import Any

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.link import Link
from offboard.loadgen.scenario.event_timeline import EVENTS_MAX, Event
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN

# Gives the events of a fault from its begin and its end in seconds, and from the link without the fault.
Fault = Callable[[float, float, Link], Iterator[Event]]


@dataclass(frozen=True)
class Chaos:
    """`[chaos]`: one fault in every period of `every_s` seconds, at a random moment of it."""

    every_s: float = setting(20.0, "length of a period with one fault, in seconds", minimum=0.1)
    last_s: float = setting(3.0, "how long a fault lasts, in seconds", minimum=0.0)
    faults: tuple[str, ...] = setting((), "faults to draw from; empty: all faults")

    def __post_init__(self) -> None:
        check(self)
        if self.last_s >= self.every_s:
            raise ConfigError(f"chaos.last_s: {self.last_s:g} is not below every_s {self.every_s:g}")
        for name in self.faults:
            if name not in FAULTS:
                raise ConfigError(f"chaos.faults: {name!r} is not one of {', '.join(FAULTS)}")

    def events(self, seed: int, duration_s: float, link: Link) -> tuple[Event, ...]:
        """The events of a run of `duration_s` seconds on `link`. Every fault ends before the run does."""
        random, count = Random(seed), int(duration_s // self.every_s)
        if 2 * count > EVENTS_MAX:
            raise ConfigError(f"chaos.every_s: {2 * count} events, at most {EVENTS_MAX} are allowed")
        events: list[Event] = []
        for n in range(count):
            begin_s = self.every_s * n + random.uniform(0, self.every_s - self.last_s)
            fault = FAULTS[random.choice(self.faults or tuple(FAULTS))]
            events += fault(round(begin_s, 3), round(begin_s + self.last_s, 3), link)
        return tuple(events)


def _condition(name: str, value: Any) -> Fault:
    """A fault that sets a condition of the link in both directions, then restores both."""

    def events(begin_s: float, end_s: float, link: Link) -> Iterator[Event]:
        yield Event("link", {name: value}, at_s=begin_s)
        before = {"up": {name: getattr(link.up, name)}, "down": {name: getattr(link.down, name)}}
        yield Event("link", before, at_s=end_s)

    return events


def _part(begin: str, end: str, part: str) -> Fault:
    def events(begin_s: float, end_s: float, _link: Link) -> Iterator[Event]:
        yield Event(begin, part, at_s=begin_s)
        yield Event(end, part, at_s=end_s)

    return events


def _reset(begin_s: float, _end_s: float, _link: Link) -> Iterator[Event]:
    yield Event("reset", True, at_s=begin_s)


def _hogs(begin_s: float, end_s: float, _link: Link) -> Iterator[Event]:
    yield Event("hogs", {ROBOT: 1}, at_s=begin_s)
    yield Event("hogs", {ROBOT: 0}, at_s=end_s)


FAULTS: dict[str, Fault] = {
    "outage": _condition("outage", True),
    "hang": _condition("hang", True),
    "loss": _condition("loss", 0.1),
    "delay": _condition("delay_ms", 150.0),
    "truncate": _condition("truncate_bytes", 2000),
    "reset": _reset,
    "hogs": _hogs,
    "kill-cloud": _part("kill", "start", CLOUD),
    "pause-cloud": _part("pause", "resume", CLOUD),
    "kill-wan": _part("kill", "start", WAN),
}
