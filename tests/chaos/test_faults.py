"""The list of faults, played on both testbeds: no answer is lost, wrong or very late, and nothing is left.

`make test-all` plays some of them once, `make chaos` all: 20 times on loopback and 3 times in containers.
"""

import contextlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from offboard.loadgen.play import play_scenario
from offboard.loadgen.play.play_scenario import Played, play
from offboard.loadgen.play.run_files import EVENTS, TRACE
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.scenario.event_timeline import Event
from offboard.loadgen.scenario.scenario import CloudPart, RobotPart, Scenario, Workload
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN
from tests.chaos.plays import ALL, FAULT_TIMES, FEW_FAULTS
from tests.compose.conftest import made_by_docker

MAP = Path(__file__).parents[2] / "maps" / "depot.yaml"
RATE = 20.0
TIMEOUT_S = 0.5
HUNG_S = 15.0  # longer than the timeout and the queue of onboard plans after it


@dataclass(frozen=True)
class Fault:
    """The events that begin and end a fault, how long it lasts, and the seconds from one to the next."""

    begin: tuple[str, object]
    end: tuple[str, object] | None = None
    last_s: float = 1.0
    every_s: float = 3.0

    def events(self, times: int) -> Iterator[Event]:
        for n in range(times):
            begin_s = 1.0 + n * self.every_s
            yield Event(*self.begin, at_s=begin_s)
            if self.end is not None:
                yield Event(*self.end, at_s=begin_s + self.last_s)


FAULTS = {
    "cloud killed": Fault(("kill", CLOUD), ("start", CLOUD), every_s=7.0),
    "cloud restarted": Fault(("restart", CLOUD), every_s=6.0),
    "cloud stopped where it is": Fault(("pause", CLOUD), ("resume", CLOUD)),
    "outage": Fault(("link", {"outage": True}), ("link", {"outage": False})),
    "reset": Fault(("reset", True), every_s=1.0),
    "hang": Fault(("link", {"hang": True}), ("link", {"hang": False})),
    "truncation": Fault(
        ("link", {"down": {"truncate_bytes": 3000}}), ("link", {"down": {"truncate_bytes": 0}})
    ),
    "relay killed": Fault(("kill", WAN), ("start", WAN), every_s=4.0),
    "robot killed": Fault(("kill", ROBOT), ("start", ROBOT), every_s=7.0),
    "network cut": Fault(("cut", CLOUD), ("join", CLOUD)),
}
UNSEEN = ("robot killed",)  # with this fault, no task needs to fall back to onboard


LOCAL = pytest.param("local", marks=pytest.mark.integration)
DOCKER = pytest.param("docker", marks=pytest.mark.compose)
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(autouse=True)
def nothing_left(request: pytest.FixtureRequest) -> Iterator[None]:
    """After the test, no process, container, network, socket or open file of the testbed is left.

    Things that an earlier killed testbed left behind may disappear, because a testbed removes them.
    """
    testbed = request.getfixturevalue("testbed")
    if testbed == "docker":
        request.getfixturevalue("engine")
    left = {"local": processes, "docker": made_by_docker}[testbed]
    before, files = set(left()), open_files()
    yield
    assert set(left()) <= before
    assert open_files() <= files + 1, "a socket or file of the testbed is still open"


def open_files() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def processes() -> list[str]:
    """The command lines of the parts that this process started."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == os.getpid():
                found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace"))
    return found


def scenario(fault: Fault | None, times: int) -> Scenario:
    """Plans on a real map, sent to the cloud at a steady rate, and the fault `times` times."""
    seconds = 3.0 if fault is None else 2.0 + times * fault.every_s
    workload = Workload(
        map=MAP, resolution=0.05, tasks=int(RATE * seconds), arrivals="poisson", rate=RATE, jump=True
    )
    robot = RobotPart(cpus=1.0, policy="cloud", timeout_s=TIMEOUT_S)
    events = () if fault is None else tuple(fault.events(times))
    return Scenario("fault", 7, workload, "", robot, (CloudPart(),), {"delay_ms": 5.0}, events)


def check(played: Played) -> None:
    """Every task was answered exactly once, correctly, and in time."""
    figures = play_scenario.figures(played.outcome, played.scenario)
    assert (figures["lost"], figures["wrong"], figures["failed"]) == (0, 0, 0), [
        one.wrong or one.error for one in played.outcome.answered if one.wrong or one.error
    ]
    numbers = sorted(one.i for one in played.outcome.answered)
    assert numbers == list(range(played.scenario.workload.tasks))
    assert max(one.response_s for one in played.outcome.answered) < HUNG_S


@pytest.mark.parametrize(
    ("testbed", "name"),
    [
        pytest.param(testbed, name, marks=mark)
        for testbed, mark in (("local", pytest.mark.integration), ("docker", pytest.mark.compose))
        for name in FAULTS
        if ALL or name in FEW_FAULTS[testbed]
    ],
)
def test_a_fault_costs_no_task(testbed: str, name: str, tmp_path: Path) -> None:
    """Every task is answered correctly, the trace is complete, and some tasks fell back to onboard."""
    times = FAULT_TIMES[testbed]
    played = play(scenario(FAULTS[name], times), tmp_path, testbed, quiet=True)
    check(played)
    assert played.exit_codes[ROBOT] == 0
    happened = [json.loads(line) for line in (tmp_path / EVENTS).read_text().splitlines()]
    assert all(one["happened_s"] is not None and "skipped" not in one for one in happened), happened
    records = list(read_trace(tmp_path / TRACE))
    ids = {record["id"] for record in records}
    assert len(ids) == len(records)
    relays = 1 + (times if name == "relay killed" else 0)
    assert len(list(tmp_path.glob("link*.jsonl"))) == relays, "the link record of a killed relay is kept"
    fell_back = sum(record["used"] != CLOUD for record in records)
    print(f"{name} x {times} on {testbed}: {len(records)} tasks, {fell_back} answered onboard")
    assert fell_back or name in UNSEEN
