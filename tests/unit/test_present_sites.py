"""Sites that come and go while tasks run, with an offloader in virtual time and no thread."""

import threading
from collections.abc import Callable

import pytest

from offboard.common.errors import ConfigError, OffloadError
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client import policies
from offboard.robot_client.discovery.present_sites import LEAVING_MAX_S, LEAVING_MIN_S, PresentSites
from offboard.robot_client.discovery.roster import LOOK_EVERY, LOOK_S, TRY_EVERY, Roster, Server
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.predictors.base import WARM_UP
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import ONBOARD, Execution, Sending
from tests.fakes import ScriptedRunner
from tests.virtual import VirtualClock, VirtualRunner

WAIT_S = 5.0


@task("carried", size=float)
def carried(number: int) -> int:
    return number


class World:
    """A robot whose servers are virtual: GPU is fast, all others are as slow as asked."""

    def __init__(self, *listed: str, known: int = 4, takes_s: float = 0.1) -> None:
        self.clock = VirtualClock()
        self.runners: dict[str, VirtualRunner] = {}
        self.takes_s = takes_s
        onboard = VirtualRunner(ONBOARD, self.clock, 1.0)
        self.sites = PresentSites(
            [onboard], roster=Roster(known), connect=self.connect, clock_s=self.clock.now_s
        )
        self.list(*listed)
        self.offload = Offloader(
            self.sites,
            policy=policies.make("greedy"),
            memories=Settings().make_memories("greedy"),
            clock=self.clock,
        )

    def list(self, *sites: str) -> None:
        self.sites.follow([Server(site, f"tcp://{n}.test:5555") for n, site in enumerate(sites)])

    def connect(self, server: Server) -> VirtualRunner:
        if server.site == "broken":
            raise OffloadError("no file is left")
        self.runners[server.site] = VirtualRunner(server.site, self.clock, self.takes_s)
        return self.runners[server.site]

    def pass_time(self, seconds: float) -> None:
        self.clock.wait([], seconds)
        self.sites.refresh()


def test_a_listed_server_is_used_and_one_that_left_is_not() -> None:
    """Tasks follow the list, and the runner of a server that left is closed at the next change."""
    world = World("a")
    for _ in range(10):
        world.offload(carried, 1)
    assert world.offload.last is not None
    assert world.offload.last.used == "a"
    gone = world.runners["a"]
    asked = len(gone.tasks)
    world.list("b")
    for _ in range(10):
        world.offload(carried, 1)
    assert world.offload.last.used == "b"
    assert len(gone.tasks) == asked
    world.pass_time(LEAVING_MIN_S)
    assert gone.closed


def test_a_task_that_was_decided_before_its_server_left_is_answered_there() -> None:
    """Nothing runs on the server when it leaves: it is still there for tasks that go there a moment later."""
    world = World("a")
    before = world.sites["a"]
    world.list()
    world.pass_time(LEAVING_MIN_S / 2)
    assert not world.runners["a"].closed
    before.submit(Task(kind_of(carried), (1,), 1.0), 60.0)
    world.pass_time(LEAVING_MIN_S / 2)
    assert world.runners["a"].closed


def test_a_long_task_ends_with_its_list_but_not_with_a_trial() -> None:
    """It has LEAVING_MAX_S on a server that no list names, and all its time on one that a list names."""
    world = World(*(f"planners/{n}" for n in range(5)))
    (tried,) = {f"planners/{n}" for n in range(5)} - set(world.sites)
    long = world.runners.copy()
    world.sites.in_flight = lambda site: int(site != tried)
    for look in range(1, TRY_EVERY + 1):
        for _ in range(LOOK_EVERY):
            world.sites.count_task(dict.fromkeys(world.sites, 0.1), look * LOOK_S)
    (left,) = long.keys() - set(world.sites)
    world.pass_time(2 * LEAVING_MAX_S)
    assert not long[left].closed
    world.list()
    world.pass_time(LEAVING_MAX_S - 1.0)
    assert not any(long[site].closed for site in long if site != left)
    world.pass_time(1.0)
    assert all(one.closed for one in long.values())


def test_a_server_that_returns_while_it_has_tasks_keeps_its_connection() -> None:
    """One server never has two connections at once, because the tasks on them could not be told apart."""
    world = World("a")
    before = world.sites["a"]
    world.sites.in_flight = lambda _: 1
    world.list()
    assert set(world.sites) == {ONBOARD}
    world.list("a")
    assert world.sites["a"] is before
    world.pass_time(LEAVING_MAX_S)
    assert not world.runners["a"].closed


def test_no_task_waits_while_servers_are_connected() -> None:
    """A task can be counted, and even make the robot look for other servers, while a connection is made."""
    world = World()
    looked: list[bool] = []

    def count() -> None:
        for number in range(LOOK_EVERY):
            sites.count_task({}, number * LOOK_S)

    def connect(server: Server) -> VirtualRunner:
        tasks = threading.Thread(target=count, daemon=True)
        tasks.start()
        tasks.join(WAIT_S)
        looked.append(tasks.is_alive())
        return VirtualRunner(server.site, world.clock)

    sites = PresentSites([VirtualRunner(ONBOARD, world.clock)], roster=Roster(), connect=connect, tended=True)
    sites.follow([Server("a", "tcp://a.test:5555")])
    assert looked == [False]


def test_a_task_keeps_the_sites_that_were_present_when_it_began() -> None:
    """The server leaves while its task runs: the answer still comes from there."""
    world = World("a")
    for _ in range(10):
        world.offload(carried, 1)
    world.clock.after(0.05, world.list)
    assert world.offload(carried, 7) == 7
    assert world.offload.last is not None
    assert world.offload.last.used == "a"
    assert world.offload(carried, 8) == 8
    assert world.offload.last.used == ONBOARD


def test_a_server_that_returns_is_known() -> None:
    """Its memory was kept, so there is no second warm-up."""
    world = World("a")
    for _ in range(10):
        world.offload(carried, 1)
    world.list()
    world.offload(carried, 1)
    world.list("a")
    expected = world.offload.expect(carried, 1)
    assert expected["a"].seconds == pytest.approx(0.1, rel=0.1)


def test_of_a_large_group_the_dead_servers_are_left() -> None:
    """Of 20 servers 4 are in use; those that fail are replaced by others, and closed."""
    world = World(*(f"planners/{n:02}" for n in range(20)))
    assert len(world.sites) == 5
    dead = [site for site in world.sites if site != ONBOARD]
    for site in dead:
        world.runners[site].takes = None
    for _ in range(20 * LOOK_EVERY):
        world.offload(carried, 1)
        world.clock.after(LOOK_S, lambda: None)
        world.clock.run_out()
    assert world.offload.last is not None
    assert world.offload.last.used not in (ONBOARD, *dead)
    assert world.offload.last.waited_s < 0.2


def test_a_call_pinned_to_a_group_or_to_a_site_that_left() -> None:
    """A group stands for its best server; without any server there, onboard answers."""
    world = World("planners/a", "planners/b")
    for _ in range(10):
        world.offload(carried, 1)
    assert world.offload.map(carried, [1, 2, 3], where="planners") == [1, 2, 3]
    world.offload(carried, 1, where="planners")
    assert world.offload.last is not None
    assert str(world.offload.last.used).startswith("planners/")
    world.list()
    assert world.offload(carried, 1, where="planners") == 1
    assert world.offload.map(carried, [1, 2, 3], where="planners/a") == [1, 2, 3]
    assert world.offload.last.used == ONBOARD
    assert "pinned to planners/a, which cannot take it" in world.offload.last.decision.reason


def test_a_batch_goes_on_when_its_servers_leave() -> None:
    """All items are answered, those of the servers that left onboard."""
    world = World("a", "b")
    for _ in range(10):
        world.offload(carried, 1)
    world.clock.after(0.3, world.list)
    assert world.offload.map(carried, range(40)) == list(range(40))


def test_a_batch_uses_the_servers_that_come() -> None:
    """All names change while it runs, and the new server gets items too."""
    world = World("a")
    for _ in range(10):
        world.offload(carried, 1)
    world.clock.after(0.3, lambda: world.list("b"))
    assert world.offload.map(carried, range(40)) == list(range(40))
    assert world.runners["a"].tasks
    assert world.runners["b"].tasks


def test_a_server_that_cannot_be_connected_to_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """The others are used; it is tried again at each refresh without a further line."""
    world = World("broken", "a")
    world.sites.refresh()
    assert set(world.sites) == {ONBOARD, "a"}
    assert caplog.text.count("broken: no file is left") == 1


def test_each_site_has_one_name() -> None:
    """Two runners of one site, or none of onboard, are refused."""
    clock = VirtualClock()
    for names in ([ONBOARD, "a", "a"], ["a"]):
        with pytest.raises(ConfigError, match="each site once, and 'onboard' among them"):
            PresentSites([VirtualRunner(name, clock) for name in names])


class ArrivalRunner(ScriptedRunner):
    """Onboard. A server comes when the caller's thread asks `looks` times more what a task would send."""

    def __init__(self) -> None:
        super().__init__(ONBOARD, answered_by(ONBOARD))
        self.sites = PresentSites(
            [self], roster=Roster(), connect=lambda one: ScriptedRunner(one.site, answered_by(one.site))
        )
        self.looks = 0
        self._caller = threading.get_ident()

    def to_send(self, task: Task) -> Sending:
        if threading.get_ident() == self._caller:
            self.looks -= 1
            if not self.looks:
                self.sites.follow([Server("g/new", "tcp://new.test:5555")])
        return super().to_send(task)


def answered_by(site: str) -> Callable[[Task], Execution]:
    """Right answers that took as long as the task is large."""
    return lambda one: Execution(site, one.size / 100, one.args[0], queue_s=0.0, run_s=one.size / 100)


@pytest.mark.parametrize("look", range(1, 60, 3))
def test_a_server_that_comes_while_a_batch_is_placed_loses_no_task(look: int) -> None:
    """Whenever it comes, all answers are right; as any other site, it is warmed up first."""
    onboard, records = ArrivalRunner(), list[Record]()
    with Offloader(
        onboard.sites,
        policy=policies.make("greedy"),
        memories=Settings().make_memories("greedy"),
        observers=[records.append],
    ) as offload:
        for number in range(1, 1 + WARM_UP):
            offload(carried, number)
        onboard.looks = look
        assert offload.map(carried, range(1, 31)) == list(range(1, 31))
    batch = [one.decision for one in records if one.decision.policy == "map"]
    new = [one.reason for one in batch if one.site == "g/new"]
    assert all(one.startswith("warm-up") for one in new[:WARM_UP]), new
