"""One run of a scenario on a testbed: what each part is started with, and what happens to it when.

Where the parts are is the testbed's business, what is made of their files `play`'s.
"""

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from offboard.common.errors import ConfigError, OffloadError
from offboard.loadgen.scenario.outcome import Reading
from offboard.loadgen.scenario.scenario import Scenario, Workload
from offboard.loadgen.scenario.timeline import ON_A_PART, Event, Timeline, absent_at_first
from offboard.loadgen.table.disturbance import WAYS
from offboard.loadgen.testbed.part import USAGE_EXIT
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN, Setup, Testbed
from offboard.robot_client.simulated.answers import BEGIN_S

TRACE = "trace.jsonl"
ANSWERS = "answers.jsonl"
LINK = "link.jsonl"
EVENTS = "events.jsonl"
READINGS = "usage.jsonl"
PLANNER = "offboard.common.planning.planner"
POLL_S = 0.02
READ_EVERY_S = 2.0
BOOT_CPUS = 1.0
ROBOT_S_A_TASK = 10.0  # a run that takes longer than this for each of its tasks has hung
ROBOT_S_AT_LEAST = 300.0
ROBOT_SEED_STEP = 1_000_003  # robots of one run differ, and so do runs with neighbouring seeds


@dataclass(frozen=True, slots=True)
class Files:
    """What one robot of a run writes, and the seed that it does it by."""

    robot: str
    trace: Path
    answers: Path
    seed: int

    @classmethod
    def of(cls, scenario: Scenario, out: Path) -> Iterator[Self]:
        """Of every robot, the first one's under plain names."""
        for n, robot in enumerate(scenario.robots()):
            suffix = robot.removeprefix(ROBOT)
            trace, answers = (out / name.replace(".", f"{suffix}.", 1) for name in (TRACE, ANSWERS))
            yield cls(robot, trace, answers, scenario.seed + n * ROBOT_SEED_STEP)


def make_room(out: Path) -> None:
    """Make the folder; what an earlier run left there is removed."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in ("trace*.jsonl", "answers*.jsonl", "link*.jsonl", EVENTS, READINGS, "summary.json"):
            for left in out.glob(name):
                left.unlink()
    except OSError as error:
        raise ConfigError(f"--out: {out} cannot be written to: {error.strerror}") from error


def setups(scenario: Scenario, out: Path, *, shown: bool = True) -> dict[str, Setup]:
    """How each part is started, paths as they are here; the first robot `shown` or not."""
    workload, cloud = scenario.workload, scenario.cloud
    module = workload.task.partition(":")[0] if workload.task else PLANNER
    parts = {
        CLOUD: Setup({"executor": cloud.executor, "workers": cloud.workers, "tasks": module}, cloud.cpus),
        WAN: Setup({**scenario.link, "seed": scenario.seed, "truth": out / LINK}),
    }
    for files in Files.of(scenario, out):
        first = files.robot == ROBOT
        parts[files.robot] = Setup(
            _robot_flags(scenario, files, first),
            scenario.robot.cpus,
            shown=shown and first,
            command="call" if workload.map is None else "drive",
        )
    return parts


def _robot_flags(scenario: Scenario, files: Files, first: bool) -> Mapping[str, Any]:
    """Flags of `robot-client drive` or `call`; only the first robot measures --alone and --reference."""
    workload, robot = scenario.workload, scenario.robot
    flags = {
        **(_map_flags(workload) if workload.map else {"task": workload.task}),
        "sizes": _sizes(workload.sizes),
        "tasks": workload.tasks,
        "arrivals": workload.arrivals,
        "rate": workload.rate,
        "burst": workload.burst,
        "in_flight": workload.in_flight,
        "measure": workload.measure,
        "alone": workload.alone if first else 0,
        "reference": workload.reference if first else 0,
        "policy": robot.policy,
        "predictor": robot.predictor,
        "window": robot.window,
        "timeout": robot.timeout_s,
        "seed": files.seed,
        "trace": files.trace,
        "answers": files.answers,
    }
    return {name: value for name, value in flags.items() if value is not None}


def _map_flags(workload: Workload) -> Mapping[str, Any]:
    return {
        "map": workload.map,
        "resolution": workload.resolution,
        "planner": workload.planner,
        "jump": workload.jump,
        "obstacles": workload.obstacles,
        "radius": workload.radius_m,
    }


def _sizes(texts: tuple[str, ...]) -> str | Path | None:
    if not texts:
        return None
    return Path(texts[0]) if texts[0].endswith(".csv") else ",".join(texts)


class Player:
    """Plays the scenario once, on a testbed whose cloud and relay are ready.

    Writes the events as they happened, and what the parts used, into the run's folder; what people may want
    to hear goes to `say`.
    """

    def __init__(self, scenario: Scenario, testbed: Testbed, say: Callable[[str], None]) -> None:
        self._scenario = scenario
        self._say = say
        self._testbed = testbed
        self._robots = scenario.robots()
        self._parts = {CLOUD, WAN}  # those that were started
        self._paused: set[str] = set()  # those that can be asked for nothing
        self._timeline = Timeline(scenario.timeline())
        self._answers = Lines(testbed.out / ANSWERS)
        self._booting: dict[str, Path] = {}  # robots that have not begun, and the file that they begin with
        self._began_s: float | None = None  # when the first task was due
        self._read_s = 0.0  # since then, when the parts' use is read again

    def play(self) -> dict[str, int]:
        """Start the robots, make each event happen when it is due, return the robots' exit codes."""
        limit_s = self._limit_s()
        until = time.monotonic() + limit_s
        self._start_all(until)
        out = self._testbed.out
        with (out / EVENTS).open("w", buffering=1) as events, (out / READINGS).open("w", buffering=1) as use:
            while not self._over():
                if time.monotonic() > until:
                    raise OffloadError(f"the robots have not ended after {limit_s:g} s")
                time.sleep(POLL_S)
                self._look(events.write, use.write)
            for event in self._timeline.left():
                events.write(json.dumps({**event.shown(), "happened_s": None}) + "\n")
        codes = {robot: self._code(robot) or 0 for robot in self._ended()}
        for robot, code in codes.items():
            if code == USAGE_EXIT:
                raise ConfigError(
                    f"{robot} refuses its settings: what it says is above, or in {out / 'logs'}"
                )
        return codes

    def _look(self, note_event: Callable[[str], object], note_use: Callable[[str], object]) -> None:
        """Make happen what is due by now."""
        self._hold()
        if self._began_s is None:
            if not self._answers.path.exists():
                return
            self._began_s = time.monotonic() + BEGIN_S
        now_s, answered = time.monotonic() - self._began_s, self._answers.count()
        for event in self._timeline.due(now_s, answered):
            line = {**event.shown(), "happened_s": round(time.monotonic() - self._began_s, 3)}
            line["answered"] = self._answers.count()
            if (why := self._in_vain(event)) is not None:
                line["skipped"] = why
            else:
                self._apply(event)
            line["took_s"] = round(time.monotonic() - self._began_s - line["happened_s"], 3)
            note_event(json.dumps(line) + "\n")
        if now_s >= self._read_s:
            self._read_s += READ_EVERY_S
            for part in sorted(self._parts - self._paused):
                with contextlib.suppress(OffloadError):  # it has ended, or does so this instant
                    reading = Reading(round(now_s, 3), part, **asdict(self._testbed.usage(part)))
                    note_use(json.dumps(asdict(reading)) + "\n")

    def _in_vain(self, event: Event) -> str | None:
        """Why it cannot happen now."""
        for part in event.parts():
            if event.action == "start":
                if part in self._parts and self._code(part) is None:
                    return f"{part} was running"
            elif event.action != "restart":
                if part not in self._parts or self._code(part) is not None:
                    return f"{part} was not running"
                if (event.action, part in self._paused) in (("pause", True), ("resume", False)):
                    return f"{part} was {'' if part in self._paused else 'not '}paused"
        return None

    def _apply(self, event: Event) -> None:
        (part,) = event.parts() if event.action in ON_A_PART else (None,)
        if part == WAN and event.action in ("start", "restart"):
            self._keep_truth()
        if part in self._robots and event.action == "start":
            self._start(part)
        else:
            event.apply(self._testbed)
        if part is not None and event.action == "pause":
            self._paused.add(part)
        elif part is not None and event.action not in ("cut", "join"):
            self._paused.discard(part)

    def _keep_truth(self) -> None:
        """A relay that is started again writes its truth anew: that of the last one is link-1.jsonl, ..."""
        truth = self._testbed.out / LINK
        if truth.exists():
            count = sum(1 for _ in truth.parent.glob(f"{truth.stem}-*.jsonl"))
            truth.rename(truth.with_stem(f"{truth.stem}-{count + 1}"))

    def _start_all(self, until: float) -> None:
        """The robots that are there from the start, the first one when the others have begun."""
        later = absent_at_first(self._scenario.timeline())
        for robot in reversed(self._robots):
            if robot == ROBOT:
                while self._booting and time.monotonic() < until and not self._ended():
                    time.sleep(POLL_S)
                    self._hold()
            if robot not in later:
                self._start(robot)

    def _hold(self) -> None:
        """Give every robot that begins now its quota."""
        for robot in [robot for robot, begun in self._booting.items() if begun.exists()]:
            del self._booting[robot]
            self._testbed.set_cpus(robot, self._scenario.robot.cpus)
            self._say(f"{robot} has begun; quota: {self._testbed.held(robot)}")

    def _ended(self) -> list[str]:
        return [robot for robot in self._robots if robot in self._parts and self._code(robot) is not None]

    def _start(self, robot: str) -> None:
        """A robot that has not begun yet gets CPU enough to be ready soon, and its quota when it begins."""
        self._testbed.start(robot)
        self._parts.add(robot)
        begun = next(
            files.answers for files in Files.of(self._scenario, self._testbed.out) if files.robot == robot
        )
        if not begun.exists() and self._scenario.robot.cpus < BOOT_CPUS:
            self._testbed.set_cpus(robot, BOOT_CPUS)
            self._booting[robot] = begun

    def _code(self, part: str) -> int | None:
        return self._testbed.exit_code(part)

    def _over(self) -> bool:
        """All robots have ended, and none is started any more."""
        if len(self._ended()) < sum(robot in self._parts for robot in self._robots):
            return False
        return not any(
            event.action in ("start", "restart") and event.value in self._robots and event.at_s is not None
            for event in self._timeline.left()
        )

    def _limit_s(self) -> float:
        workload = self._scenario.workload
        runs = workload.tasks + len(WAYS) * workload.alone
        return max(ROBOT_S_AT_LEAST, ROBOT_S_A_TASK * runs)


class Lines:
    """Counts the whole lines of a file that grows."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._count = self._read = 0

    def count(self) -> int:
        if self.path.exists():
            with self.path.open("rb") as file:
                file.seek(self._read)
                new = file.read()
            self._count += new.count(b"\n")
            self._read += len(new)
        return self._count
