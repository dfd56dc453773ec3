"""Link schedules: read, sorted, checked, and played."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.relay.link.link import Link, LinkConditions
from offboard.loadgen.relay.link_schedule import EVENTS_MAX, Schedule, parse_schedule, read_schedule

GOOD = """
[[event]]
at_s = 9
up = {outage = false}

[[event]]
at_s = 2.5
loss = 0.1
down = {delay_ms = 7.0}

[[event]]
at_s = 9.0
reset = true
"""


class Recorder:
    """A link that remembers what is done to it."""

    def __init__(self) -> None:
        self.link = Link()
        self.done: list[Any] = []

    def set_link(self, link: Link, by: str) -> None:
        self.link = link
        self.done.append((by, link))

    def reset(self) -> int:
        self.done.append("reset")
        return 0


def test_events_come_in_order_of_time(tmp_path: Path) -> None:
    """Events are sorted by time; events at the same time keep the order of the file."""
    file = tmp_path / "events.toml"
    file.write_text(GOOD)
    events = read_schedule(file, Link())
    assert [event.shown() for event in events] == [
        {"at_s": 2.5, "loss": 0.1, "down": {"delay_ms": 7.0}},
        {"at_s": 9.0, "up": {"outage": False}},
        {"at_s": 9.0, "reset": True},
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[event]]\nat_s = 1\nup = {outge = true}\n", ":3: unknown key 'outge'; did you mean 'outage'?"),
        (
            "[[event]]\nat_s = 1\noutage = true\n\n[[event]]\nat_s = 2\nup.delay = 3\n",
            ":7: unknown key 'delay'; did you mean 'delay_ms'?",
        ),
        ("[[event]]\nat_s = 1\n[[event]]\nlos = 2\n", ":4: unknown key 'los'; did you mean 'loss'?"),
        ("[[evnt]]\nat_s = 1\n", ":1: unknown key 'evnt'; did you mean 'event'?"),
        ("[[event]]\nloss = 0.1\n", ":1: at_s: is missing"),
        ("[[event]]\nat_s = -1\n", ":2: at_s: -1 is not a number from 0 to 1e+06"),
        ("[[event]]\nat_s = nan\n", ":2: at_s: nan is not a number from 0 to 1e+06"),
        ("[[event]]\nat_s = 1\nloss = 2\n", ":3: up.loss: 2 is not a number from 0 to 1"),
        ("[[event]]\nat_s = 1\nreset = 1\n", ":3: reset: 1 is neither true nor false"),
        ("[[event]]\nat_s = 1\ndown = 3\n", ":3: down: 3 is not a table"),
        (
            '[[event]]\nat_s = 1\ndistribution = "samples"\n',
            ":1: up.samples: the list is empty, but distribution 'samples' needs delays",
        ),
        ("event = 3\n", ":1: event is not a list of tables"),
    ],
)
def test_a_bad_schedule_names_file_line_and_key(tmp_path: Path, text: str, message: str) -> None:
    """A wrong key or value is refused; the error names file and line, and the nearest known key."""
    file = tmp_path / "events.toml"
    file.write_text(text)
    with pytest.raises(DataError) as caught:
        read_schedule(file, Link())
    assert str(caught.value) == f"{file}{message}"


def test_an_error_in_json_names_the_event() -> None:
    """JSON has no line numbers, so the error names the number of the event."""
    with pytest.raises(ConfigError) as caught:
        parse_schedule({"event": [{"at_s": 1}, {"at_s": 2, "hangs": True}]}, Link())
    assert str(caught.value) == "event 2: unknown key 'hangs'; did you mean 'hang'?"


def test_a_schedule_is_bounded() -> None:
    """A schedule with too many events is refused."""
    with pytest.raises(ConfigError, match="10001 events; at most 10000 are allowed"):
        parse_schedule({"event": [{"at_s": 1}] * (EVENTS_MAX + 1)}, Link())


def test_an_event_can_use_the_samples_of_the_link() -> None:
    """An event may switch to the measured delays that the link was started with."""
    conditions = LinkConditions(samples=(1.0, 2.0))
    event = {"at_s": 1, "distribution": "samples"}
    assert parse_schedule({"event": [event]}, Link(conditions, conditions))[0].shown() == event


def test_events_due_are_played_at_once_and_in_order() -> None:
    """Events at time 0 are played when `start` returns; a later event waits, and `stop` forgets it."""
    recorder = Recorder()

    async def play() -> None:
        schedule = Schedule(recorder)
        events = [{"at_s": 0, "delay_ms": 5}, {"at_s": 0, "reset": True}, {"at_s": 1e5, "hang": True}]
        schedule.start(parse_schedule({"event": events}, Link()))
        assert schedule.status()["done"] == 2
        schedule.stop()
        assert schedule.status() == {"now_s": 0.0, "done": 0, "event": []}

    asyncio.run(play())
    delayed = LinkConditions(delay_ms=5)
    assert recorder.done == [("schedule", Link(delayed, delayed)), "reset"]
