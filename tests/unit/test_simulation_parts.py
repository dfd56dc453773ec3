"""The parts of a simulation: virtual time, a shared CPU, one way of a link, and races on them by hand."""

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import pytest

from offboard.common.errors import Overtaken
from offboard.common.host.load import SERVER_EVERY_S
from offboard.loadgen.relay.link.link import LinkConditions
from offboard.loadgen.scenario.scenario import CloudPart, read_scenario
from offboard.loadgen.scenario.timeline import Event
from offboard.loadgen.simulation.model.clock import VirtualClock
from offboard.loadgen.simulation.model.costs import HASH
from offboard.loadgen.simulation.model.lockstep import LockstepClock
from offboard.loadgen.simulation.model.one_way import Way
from offboard.loadgen.simulation.model.processor import Processor, Run
from offboard.loadgen.simulation.model.server import Server
from offboard.loadgen.simulation.model.simulated_tasks import find_tasks
from offboard.loadgen.simulation.world import World
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client import predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Decision, Forecast, Hedge, Probe
from offboard.robot_client.records.trace import Record
from offboard.robot_client.sites.heartbeat import Told

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


def test_waiting_ends_with_the_first_future_or_the_time() -> None:
    """Events happen in order, those of one instant as they were set, and none after the wait is over."""
    clock, seen, done = VirtualClock(), [], Future[None]()
    for name, due_s in (("c", 3.0), ("a", 1.0), ("b", 1.0)):
        clock.at(due_s, lambda name=name: seen.append(name))
    clock.at(2.0, lambda: done.set_result(None))
    clock.wait([Future(), done], 9.0)
    assert (clock.now_s(), seen) == (2.0, ["a", "b"])
    clock.wait([done])
    assert clock.now_s() == 2.0
    clock.wait([Future()], 0.5)
    assert (clock.now_s(), seen) == (2.5, ["a", "b"])
    clock.pass_by(1.5)
    assert (clock.now_s(), seen) == (4.0, ["a", "b", "c"])


def test_askers_run_one_at_a_time_in_order() -> None:
    """Each until it waits; those that wait for one event go on in the order in which they began."""
    clock, seen, gate = LockstepClock(), [], Future[None]()

    def asker(name: str, seconds: float) -> Callable[[], None]:
        def ask() -> None:
            seen.append(f"{name} at {clock.now_s():g}")
            clock.pass_by(seconds)
            seen.append(f"{name} at {clock.now_s():g}")
            clock.wait([gate])
            seen.append(f"{name} at {clock.now_s():g}")

        return ask

    clock.begin(asker("a", 2.0))
    clock.begin(asker("b", 1.0))
    clock.at(5.0, lambda: gate.set_result(None))
    clock.pass_by(9.0)
    assert seen == ["a at 0", "b at 0", "b at 1", "a at 2", "b at 5", "a at 5"]


def test_what_an_asker_raises_is_raised_to_whoever_lets_time_go_by() -> None:
    """Nothing fails unseen in a thread."""
    clock = LockstepClock()

    def ask() -> None:
        clock.pass_by(1.0)
        raise ValueError("seen")

    clock.begin(ask)
    with pytest.raises(ValueError, match="seen"):
        clock.pass_by(2.0)


def test_work_shares_the_quota_with_hogs() -> None:
    """A second of work takes two on half a CPU; while a hog is there, twice as long."""
    clock, ended = VirtualClock(), []
    processor = Processor(clock, cpus=0.5)
    for _ in range(2):
        processor.add(1.0, lambda run: ended.append((run.added_s, run.begun_s, clock.now_s())))
    clock.at(1.0, lambda: processor.change(hogs=1))
    clock.at(3.0, lambda: processor.change(hogs=0))
    clock.pass_by(9.0)
    assert ended == [(0.0, 0.0, pytest.approx(3.0)), (0.0, pytest.approx(3.0), pytest.approx(5.0))]
    assert (processor.own_s, processor.others_s) == (pytest.approx(2.0), pytest.approx(0.5))


def test_a_server_knows_what_hogs_take_of_its_cpu() -> None:
    """As it reads it ten times a second, and the quota that it has then."""
    clock = VirtualClock()
    server = Server(clock, CloudPart(cpus=1.0))
    clock.pass_by(1.0)
    assert server.told == Told(0, 0.0, 1.0)
    server.processor.change(hogs=3, cpus=0.5)
    clock.pass_by(2 * SERVER_EVERY_S)
    assert server.told == Told(0, 1.0, 0.5)
    server.processor.change(hogs=0, cpus=2.0)
    clock.pass_by(2 * SERVER_EVERY_S)
    assert server.told == Told(0, 0.0, 1.0)


def test_workers_share_it_among_them_too() -> None:
    """Two at a time on one CPU take twice as long each, the third begins then; what is paused waits."""
    clock, ended = VirtualClock(), []
    processor = Processor(clock, cpus=1.0, workers=2)
    for _ in range(3):
        processor.add(1.0, lambda _: ended.append(clock.now_s()))
    clock.at(0.5, lambda: processor.change(paused=True))
    clock.at(1.5, lambda: processor.change(paused=False))
    clock.pass_by(9.0)
    assert ended == [pytest.approx(3.0), pytest.approx(3.0), pytest.approx(4.0)]


def test_what_is_stopped_makes_room() -> None:
    """Half-way through the first of three tasks of 2 s, and the second one before its turn."""
    clock, ended = VirtualClock(), dict[int, float]()
    processor = Processor(clock, cpus=1.0)
    runs = [
        processor.add(2.0, lambda _, number=number: ended.update({number: clock.now_s()}))
        for number in range(3)
    ]
    clock.at(1.0, lambda: processor.stop(runs[1]))
    clock.at(1.0, lambda: processor.stop(runs[0]))
    clock.pass_by(10.0)
    assert ended == {2: pytest.approx(3.0)}


def test_what_is_new_begins_after_what_is_here_and_comes_before_it() -> None:
    """The line, and what arrives earlier, but not what the asker has there itself."""
    clock = VirtualClock()
    processor = Processor(clock, cpus=1.0)

    def nothing(_: Run) -> None:
        pass

    processor.add(1.0, nothing, owner="other")
    processor.add(2.0, nothing, owner="mine")
    clock.pass_by(0.5)
    assert processor.begins_s(0.6, [], without="mine") == pytest.approx(1.0)
    assert processor.begins_s(0.6, [(0.55, 0.2), (0.7, 5.0)], without="mine") == pytest.approx(1.2)
    assert processor.begins_s(0.6, [], without="") == pytest.approx(3.0)


def test_an_outage_holds_and_a_hang_swallows() -> None:
    """What is due in an outage comes out at its end, in order; after a hang the connection is lost."""
    clock, seen = VirtualClock(), []
    plain = LinkConditions(delay_ms=100, bandwidth_mbps=0.8)
    way = Way(clock, plain, 1, "up")
    for number in range(2):
        way.send(10_000, "m", number, lambda: seen.append(clock.now_s()))
    clock.pass_by(0.25)
    assert seen == [pytest.approx(0.2)]  # 0.1 s at the bandwidth, 0.1 s of delay
    way.change(LinkConditions(outage=True))
    clock.pass_by(1.0)
    assert way.due_s(1, "m", 9, clock.now_s()) is None
    assert way.change(plain)
    assert seen == [pytest.approx(0.2), pytest.approx(1.25)]
    way.change(LinkConditions(hang=True))
    way.send(1, "m", 3, lambda: seen.append(0.0))
    clock.pass_by(1.0)
    assert not way.change(plain)
    assert len(seen) == 2


def test_draws_are_those_of_the_message() -> None:
    """The same message has the same jitter whatever was sent before it."""
    clock, jittery = VirtualClock(), LinkConditions(delay_ms=15, jitter_ms=5, loss=0.3)
    first, second = (Way(clock, jittery, 1, "up") for _ in range(2))
    first.send(100_000, "m", 1, lambda: None)
    sent_s = [way.due_s(2000, "m", 2, 7.0) for way in (first, second)]
    assert sent_s[0] == sent_s[1]
    assert sent_s[0] != first.due_s(2000, "m", 3, 7.0)


class Scripted:
    """Decides as it was told."""

    def __init__(self, decision: Decision) -> None:
        self._decision = decision

    def decide(self, forecast: Forecast) -> Decision:  # noqa: ARG002
        return self._decision


@pytest.fixture
def race(tmp_path: Path) -> Callable[..., tuple[list[Record], float]]:
    """The records of two tasks so decided, without noise, and how long both took."""

    def run(decision: Decision, *events: Event) -> tuple[list[Record], float]:
        path = tmp_path / "small.toml"
        path.write_text(SMALL)
        scenario, clock = read_scenario(path), VirtualClock()
        tasks = {ROBOT: find_tasks(scenario.workload, 1, 2)}
        world = World(scenario, tasks, clock, heartbeat_s=0.0, noise=0.0)
        for event in events:
            world.happen(event)
        records: list[Record] = []
        offload = Offloader(
            [world.cloud, world.onboard],
            policy=Scripted(decision),
            memories=Memories(lambda: predictors.make("least-squares", 5)),
            observers=[records.append],
            clock=clock,
        )
        for _ in range(10):  # enough to be allowed a second run
            clock.pass_by(0.0)
            offload._allowance.begin(clock.now_s())
        for number in range(2):
            offload(world.truth.function, 40000.0, number)
        return records, clock.now_s()

    return run


def test_a_hedge_by_hand(race: Callable[..., tuple[list[Record], float]]) -> None:
    """The link is silent: onboard begins after the hedge's wait and answers, the cloud is given up then."""
    silent = Event("link", {"outage": True})
    records, _ = race(Decision("cloud", "", "test", second=Hedge("onboard", 0.1)), silent)
    first = records[0]
    assert first.waited_s == pytest.approx(0.1 + ONBOARD_S)
    cloud, onboard = first.executions
    assert (cloud.site, onboard.site, first.used) == ("cloud", "onboard", "onboard")
    assert isinstance(cloud.failure, Overtaken)
    assert cloud.seconds == pytest.approx(first.waited_s)
    assert onboard.seconds == pytest.approx(ONBOARD_S)


def test_a_hedge_in_time_starts_nothing(race: Callable[..., tuple[list[Record], float]]) -> None:
    """The cloud answers before the wait is over."""
    records, took_s = race(Decision("cloud", "", "test", second=Hedge("onboard", 0.1)))
    assert [len(record.executions) for record in records] == [1, 1]
    assert took_s == pytest.approx(2 * CLOUD_S)


def test_a_probe_by_hand(race: Callable[..., tuple[list[Record], float]]) -> None:
    """Both begin at once, the first answer is used, and the other one's time is learnt when it ends."""
    records, _ = race(Decision("cloud", "", "test", second=Probe("onboard")))
    assert CLOUD_S < ONBOARD_S < 2 * CLOUD_S
    # Beside the run onboard, unpacking the reply takes twice as long.
    assert records[0].waited_s == pytest.approx(CLOUD_S + HASH.sending_s / 2 / 0.2)
    assert records[0].used == "cloud"
    (late,) = records[1].late
    assert (late.id, late.site, late.ok) == (records[0].id, "onboard", True)
    assert late.seconds == pytest.approx(ONBOARD_S)
