"""Plays one run on a testbed: starts the robots, applies the due events, samples memory and handles.

`part_setups` says how the parts are started; `play_scenario` judges the files that they leave.
"""

import contextlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from offboard.common.command_line import USAGE_EXIT
from offboard.common.errors import ConfigError, OffloadError
from offboard.loadgen.play.run_files import (
    ANSWERS,
    EVENTS,
    READINGS,
    TRACE,
    LineCounter,
    RobotFiles,
    link_file,
)
from offboard.loadgen.progress import Progress
from offboard.loadgen.robot.answers import BEGIN_S
from offboard.loadgen.robot_files import alone_path
from offboard.loadgen.scenario.event_timeline import ON_A_PART, Event, Timeline, absent_at_first
from offboard.loadgen.scenario.outcome import Reading
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.table.measurement_notes import WAYS
from offboard.loadgen.testbed.testbed import ROBOT, WAN, Testbed, kind_of, relay_of

POLL_S = 0.02
READ_EVERY_S = 2.0
BOOT_CPUS = 1.0
ROBOT_S_A_TASK = 10.0  # a run that takes longer than this for each of its tasks has hung
ROBOT_S_AT_LEAST = 300.0


def started_at_first(scenario: Scenario) -> tuple[str, ...]:
    """The servers and relays that run before the robots; events start the others."""
    later = absent_at_first(scenario.timeline())
    return tuple(part for part in scenario.parts() if kind_of(part) != ROBOT and part not in later)


class Player:
    """Plays the scenario once, on a testbed whose cloud and relay are ready.

    Writes the events as they happened, and the memory and handles of the parts, into the folder of the run.
    `say` receives lines for people, `shown` the progress of the first robot.
    """

    def __init__(
        self, scenario: Scenario, testbed: Testbed, say: Callable[[str], object], shown: Progress
    ) -> None:
        self._scenario = scenario
        self._say = say
        self._shown = shown
        self._testbed = testbed
        # The robots, and the file that each one creates when it begins its first task.
        self._robots = {files.robot: files.answers for files in RobotFiles.of(scenario, testbed.out)}
        self._parts = set(started_at_first(scenario))  # the parts that were started
        self._paused: set[str] = set()  # a paused part cannot be sampled
        self._timeline = Timeline(scenario.timeline())
        self._answers = LineCounter(testbed.out / ANSWERS)
        self._alone = LineCounter(alone_path(testbed.out / TRACE))
        self._booting: dict[str, Path] = {}  # starting robots, and the file whose creation ends their start
        self._shown_steps = 0
        self._began_s: float | None = None  # when the first task was due
        self._recorded = set(scenario.recorded())  # servers whose links do not play their recordings yet
        self._next_sample_s = 0.0  # seconds after that

    def play(self) -> dict[str, int]:
        """Start the robots, apply the events until all robots have ended, and return their exit codes."""
        limit_s = max(ROBOT_S_AT_LEAST, ROBOT_S_A_TASK * self._runs())
        until = time.monotonic() + limit_s
        self._start_all(until)
        out = self._testbed.out
        with (
            (out / EVENTS).open("w", buffering=1) as events,
            (out / READINGS).open("w", buffering=1) as readings,
        ):
            while not self._over():
                if time.monotonic() > until:
                    raise OffloadError(f"the robots have not ended after {limit_s:g} s")
                time.sleep(POLL_S)
                self._poll(events.write, readings.write)
            for event in self._timeline.left():
                events.write(json.dumps({**event.shown(), "happened_s": None}) + "\n")
        codes = {robot: self._testbed.exit_code(robot) or 0 for robot in self._ended()}
        for robot, code in codes.items():
            if code == USAGE_EXIT:
                raise ConfigError(f"{robot} refuses its settings: see its message above or in {out / 'logs'}")
        return codes

    def _poll(self, write_event: Callable[[str], object], write_reading: Callable[[str], object]) -> None:
        """Do everything that is due by now."""
        self._end_boots()
        if self._began_s is None:
            if not self._answers.path.exists():
                return
            self._began_s = time.monotonic() + BEGIN_S
            self._shown.begin("tasks", self._runs())
        now_s, answered = time.monotonic() - self._began_s, self._answers.count()
        if answered + (alone := self._alone.count()) != self._shown_steps:
            self._shown_steps = answered + alone
            self._shown.to(self._shown_steps)
        if now_s >= 0:
            for server in {one for one in self._recorded if relay_of(one) in self._parts}:
                self._testbed.begin_recording(server)
                self._recorded.remove(server)
        for event in self._timeline.due(now_s, answered):
            write_event(json.dumps(self._happened(event, self._began_s)) + "\n")
            self._say(f"event: {event.in_words()}")
        if now_s >= self._next_sample_s:
            self._next_sample_s += READ_EVERY_S
            for part in sorted(self._parts - self._paused):
                with contextlib.suppress(OffloadError):  # the part has ended, maybe at this instant
                    reading = Reading(round(now_s, 3), part, **asdict(self._testbed.usage(part)))
                    write_reading(json.dumps(asdict(reading)) + "\n")

    def _happened(self, event: Event, began_s: float) -> dict[str, Any]:
        """Apply an event, unless that is impossible now; its line in the file of events."""
        line = {**event.shown(), "happened_s": round(time.monotonic() - began_s, 3)}
        line["answered"] = self._answers.count()
        if (why := self._why_impossible(event)) is not None:
            line["skipped"] = why
        else:
            self._apply(event)
        line["took_s"] = round(time.monotonic() - began_s - line["happened_s"], 3)
        return line

    def _why_impossible(self, event: Event) -> str | None:
        """Why the event cannot happen to its part now; None if it can."""
        for part in event.parts():
            if event.action == "start":
                if part in self._parts and self._testbed.exit_code(part) is None:
                    return f"{part} was running"
            elif event.action != "restart":
                if part not in self._parts or self._testbed.exit_code(part) is not None:
                    return f"{part} was not running"
                if (event.action, part in self._paused) in (("pause", True), ("resume", False)):
                    return f"{part} was {'' if part in self._paused else 'not '}paused"
        return None

    def _apply(self, event: Event) -> None:
        (part,) = event.parts() if event.action in ON_A_PART else (None,)
        if part is not None and kind_of(part) == WAN and event.action in ("start", "restart"):
            self._keep_truth(part)
            self._recorded |= {one for one in self._scenario.recorded() if relay_of(one) == part}
        if part in self._robots and event.action == "start":
            self._start(part)
        else:
            event.apply(self._testbed)
            if part is not None and event.action in ("start", "restart"):
                self._parts.add(part)
        if part is not None and event.action == "pause":
            self._paused.add(part)
        elif part is not None and event.action not in ("cut", "join"):
            self._paused.discard(part)

    def _keep_truth(self, relay: str) -> None:
        """Keep the link record of an ended relay as link-1.jsonl, ...: the next one overwrites link.jsonl."""
        truth = link_file(self._testbed.out, relay)
        if truth.exists():
            count = sum(1 for _ in truth.parent.glob(f"{truth.stem}-[0-9]*.jsonl"))
            truth.rename(truth.with_stem(f"{truth.stem}-{count + 1}"))

    def _start_all(self, until: float) -> None:
        """Start the robots that no event starts; the first robot last, once the others have begun."""
        later = absent_at_first(self._scenario.timeline())
        for robot in reversed(self._robots):
            if robot == ROBOT:
                while self._booting and time.monotonic() < until and not self._ended():
                    time.sleep(POLL_S)
                    self._end_boots()
            if robot not in later:
                self._start(robot)

    def _end_boots(self) -> None:
        """Hold each robot that has begun to its quota."""
        for robot in [robot for robot, begun in self._booting.items() if begun.exists()]:
            del self._booting[robot]
            self._testbed.set_cpus(robot, self._scenario.robot.cpus)
            self._say(f"{robot} has begun its tasks; quota: {self._testbed.held(robot)}")

    def _ended(self) -> list[str]:
        return [
            robot
            for robot in self._robots
            if robot in self._parts and self._testbed.exit_code(robot) is not None
        ]

    def _start(self, robot: str) -> None:
        """Start a robot. Until it begins its first task it may use a whole CPU, so that it is ready soon."""
        self._testbed.start(robot)
        self._parts.add(robot)
        begun = self._robots[robot]
        if not begun.exists() and self._scenario.robot.cpus < BOOT_CPUS:
            self._testbed.set_cpus(robot, BOOT_CPUS)
            self._booting[robot] = begun

    def _over(self) -> bool:
        """Whether all robots have ended and no event will start one again."""
        if len(self._ended()) < sum(robot in self._parts for robot in self._robots):
            return False
        return not any(
            event.action in ("start", "restart") and event.value in self._robots and event.at_s is not None
            for event in self._timeline.left()
        )

    def _runs(self) -> int:
        """The tasks that the first robot runs, those of `alone` included."""
        workload = self._scenario.workload
        return workload.tasks + len(WAYS) * workload.alone
