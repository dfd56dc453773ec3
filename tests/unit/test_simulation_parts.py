"""The parts of a simulation: CPU, server, link and onboard times, and races that can be computed by hand."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from offboard.common.errors import Overtaken
from offboard.common.load import SERVER_EVERY_S
from offboard.loadgen.relay.link.link import LinkConditions
from offboard.loadgen.scenario.event_timeline import Event
from offboard.loadgen.scenario.scenario import CloudPart
from offboard.loadgen.scenario.scenario_file import read_scenario
from offboard.loadgen.simulation.model.simulated_connection import Message, SimulatedDirection
from offboard.loadgen.simulation.model.simulated_cpu import Run, SimulatedCpu
from offboard.loadgen.simulation.model.simulated_server import SimulatedServer
from offboard.loadgen.simulation.model.task_costs import HASH, find_tasks
from offboard.loadgen.simulation.simulated_testbed import SimulatedTestbed
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client import predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Decision, Forecast, Hedge, Probe
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.heartbeat import ServerReport
from offboard.testing.virtual_clock import VirtualClock

SMALL = """name = "small"
[workload]
task = "offboard.loadgen.scenario.hash_tasks:hash_rounds"
sizes = ["constant:40000"]
tasks = 2
[robot]
cpus = 0.2
[link]
delay_ms = 15
bandwidth_mbps = 0
"""
ONBOARD_S = HASH.cpu_s(40000) / 0.2
CLOUD_S = HASH.sending_s / 0.2 + 0.030 + HASH.cpu_s(40000)


def test_work_shares_the_quota_with_hogs() -> None:
    """A second of work takes 2 s on half a CPU, and twice as long while there is a hog."""
    clock, ended = VirtualClock(), []
    cpu = SimulatedCpu(clock, cpus=0.5)
    for _ in range(2):
        cpu.add(1.0, lambda run: ended.append((run.added_s, run.begun_s, clock.now_s())))
    clock.at(1.0, lambda: cpu.change(hogs=1))
    clock.at(3.0, lambda: cpu.change(hogs=0))
    clock.pass_by(9.0)
    assert ended == [(0.0, 0.0, pytest.approx(3.0)), (0.0, pytest.approx(3.0), pytest.approx(5.0))]
    assert (cpu.own_s, cpu.others_s) == (pytest.approx(2.0), pytest.approx(0.5))


def test_a_server_measures_its_load_and_its_quota() -> None:
    """Ten times a second the server measures what hogs take of its CPU, and its current quota."""
    clock = VirtualClock()
    server = SimulatedServer(clock, CloudPart(cpus=1.0))
    clock.pass_by(1.0)
    assert server.told == ServerReport(0, 0.0, 1.0)
    server.cpu.change(hogs=3, cpus=0.5)
    clock.pass_by(2 * SERVER_EVERY_S)
    assert server.told == ServerReport(0, 1.0, 0.5)
    server.cpu.change(hogs=0, cpus=2.0)
    clock.pass_by(2 * SERVER_EVERY_S)
    assert server.told == ServerReport(0, 0.0, 1.0)


def test_workers_share_the_quota() -> None:
    """Two workers on one CPU take twice as long each; the third piece of work waits, as in a pause."""
    clock, ended = VirtualClock(), []
    cpu = SimulatedCpu(clock, cpus=1.0, workers=2)
    for _ in range(3):
        cpu.add(1.0, lambda _: ended.append(clock.now_s()))
    clock.at(0.5, lambda: cpu.change(paused=True))
    clock.at(1.5, lambda: cpu.change(paused=False))
    clock.pass_by(9.0)
    assert ended == [pytest.approx(3.0), pytest.approx(3.0), pytest.approx(4.0)]


def test_stopped_work_makes_room() -> None:
    """Of three tasks of 2 s, one is stopped after 1 s, and one before it begins; the third begins then."""
    clock, ended = VirtualClock(), dict[int, float]()
    cpu = SimulatedCpu(clock, cpus=1.0)
    runs = [
        cpu.add(2.0, lambda _, number=number: ended.update({number: clock.now_s()})) for number in range(3)
    ]
    clock.at(1.0, lambda: cpu.stop(runs[1]))
    clock.at(1.0, lambda: cpu.stop(runs[0]))
    clock.pass_by(10.0)
    assert ended == {2: pytest.approx(3.0)}


def test_new_work_begins_after_earlier_work() -> None:
    """Earlier work is the queue and what arrives before, without the work of the robot that asks."""
    clock = VirtualClock()
    cpu = SimulatedCpu(clock, cpus=1.0)

    def nothing(_: Run) -> None:
        pass

    cpu.add(1.0, nothing, owner="other")
    cpu.add(2.0, nothing, owner="mine")
    clock.pass_by(0.5)
    assert cpu.begins_s(0.6, [], without="mine") == pytest.approx(1.0)
    assert cpu.begins_s(0.6, [(0.55, 0.2), (0.7, 5.0)], without="mine") == pytest.approx(1.2)
    assert cpu.begins_s(0.6, [], without="") == pytest.approx(3.0)


def test_an_outage_holds_messages_and_a_hang_loses_them() -> None:
    """Messages come out at the end of an outage, in order; after a hang the connection is lost."""
    clock, seen = VirtualClock(), []
    plain = LinkConditions(delay_ms=100, bandwidth_mbps=0.8)
    direction = SimulatedDirection(clock, plain, 1, "up")
    for number in range(2):
        direction.send(Message(10_000, "m", number), lambda: seen.append(clock.now_s()))
    clock.pass_by(0.25)
    assert seen == [pytest.approx(0.2)]  # 0.1 s at the bandwidth, 0.1 s of delay
    direction.change(LinkConditions(outage=True))
    clock.pass_by(1.0)
    assert direction.due_s(Message(1, "m", 9), clock.now_s()) == math.inf
    assert direction.change(plain)
    assert seen == [pytest.approx(0.2), pytest.approx(1.25)]
    direction.change(LinkConditions(hang=True))
    direction.send(Message(1, "m", 3), lambda: seen.append(0.0))
    clock.pass_by(1.0)
    assert not direction.change(plain)
    assert len(seen) == 2


def test_draws_belong_to_the_message() -> None:
    """A message has the same jitter and loss, whatever was sent before it."""
    clock, jittery = VirtualClock(), LinkConditions(delay_ms=15, jitter_ms=5, loss=0.3)
    first, second = (SimulatedDirection(clock, jittery, 1, "up") for _ in range(2))
    first.send(Message(100_000, "m", 1), lambda: None)
    due_s = [direction.due_s(Message(2000, "m", 2), 7.0) for direction in (first, second)]
    assert due_s[0] == due_s[1]
    assert due_s[0] != first.due_s(Message(2000, "m", 3), 7.0)


class Scripted:
    """A policy that always makes the same decision, until it gets another one."""

    def __init__(self, decision: Decision) -> None:
        self.decision = decision

    def decide(self, forecast: Forecast) -> Decision:  # noqa: ARG002
        return self.decision


@pytest.fixture
def race(tmp_path: Path) -> Callable[..., tuple[list[Record], float]]:
    """Runs two tasks with this decision, without noise; returns their records and how long both took."""

    def run(decision: Decision, *events: Event) -> tuple[list[Record], float]:
        path = tmp_path / "small.toml"
        path.write_text(SMALL)
        scenario, clock = read_scenario(path), VirtualClock()
        tasks = {ROBOT: find_tasks(scenario.workload, 1, 2)}
        testbed = SimulatedTestbed(scenario, tasks, clock, heartbeat_s=0.0, noise=0.0)
        records: list[Record] = []
        policy = Scripted(Decision("cloud", "", "test"))
        offload = Offloader(
            [testbed.clouds["cloud"], testbed.onboard],
            policy=policy,
            memories=Memories(lambda: predictors.make("least-squares", 5)),
            observers=[records.append],
            clock=clock,
        )
        for number in range(10):  # enough tasks to allow a second run
            offload(testbed.costs.function, 40000.0, number)
        records.clear()
        began_s, policy.decision = clock.now_s(), decision
        for event in events:
            testbed.happen(event)
        for number in range(2):
            offload(testbed.costs.function, 40000.0, number)
        return records, clock.now_s() - began_s

    return run


def test_a_hedge_by_hand(race: Callable[..., tuple[list[Record], float]]) -> None:
    """The link is silent: onboard starts after the wait of the hedge and answers; the cloud is cancelled."""
    silent = Event("link", {"outage": True})
    records, _ = race(Decision("cloud", "", "test", second=Hedge("onboard", 0.1)), silent)
    first = records[0]
    assert first.waited_s == pytest.approx(0.1 + ONBOARD_S)
    cloud, onboard = first.executions
    assert (cloud.site, onboard.site, first.used) == ("cloud", "onboard", "onboard")
    assert isinstance(cloud.failure, Overtaken)
    assert cloud.seconds == pytest.approx(first.waited_s)
    assert onboard.seconds == pytest.approx(ONBOARD_S)


def test_an_early_answer_prevents_the_hedge(race: Callable[..., tuple[list[Record], float]]) -> None:
    """The cloud answers before the wait of the hedge is over, so onboard does not start."""
    records, took_s = race(Decision("cloud", "", "test", second=Hedge("onboard", 0.1)))
    assert [len(record.executions) for record in records] == [1, 1]
    assert took_s == pytest.approx(2 * CLOUD_S)


def test_a_probe_by_hand(race: Callable[..., tuple[list[Record], float]]) -> None:
    """Both sites start at once; the first answer is used, and the other time is learned when it is known."""
    records, _ = race(Decision("cloud", "", "test", second=Probe("onboard")))
    assert CLOUD_S < ONBOARD_S < 2 * CLOUD_S
    # During the run onboard, unpacking the reply takes twice as long.
    assert records[0].waited_s == pytest.approx(CLOUD_S + HASH.sending_s / 2 / 0.2)
    assert records[0].used == "cloud"
    (late,) = records[1].late
    assert (late.id, late.execution.site, late.execution.ok) == (records[0].id, "onboard", True)
    assert late.execution.seconds == pytest.approx(ONBOARD_S)
