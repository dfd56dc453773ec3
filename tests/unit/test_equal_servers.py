"""What equal servers of a group share, and how few probes they need: the default policy, scripted sites."""

from collections.abc import Sequence
from pathlib import Path
from random import Random

import pytest

from offboard.common.errors import CloudTimeout
from offboard.common.tasks import Kind, Task, kind_of, task
from offboard.robot_client import policies
from offboard.robot_client.discovery.present_sites import PresentSites
from offboard.robot_client.discovery.roster import Roster, Server
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.store import Store
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Probe
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.predictors.base import REMEMBERED, WARM_UP
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition, Execution
from tests.fakes import ScriptedRunner
from tests.outlooks import decide, known

GROUP = [f"planners/{name}" for name in "abcd"]
TRIP_S, RUN_S, ONBOARD_S, TIMEOUT_S = 0.01, 0.05, 0.3, 0.5
NOISE = 0.1
TASKS = 500  # in each phase
HEARTBEAT_TASKS = 8  # about the tasks between two heartbeats


@task("lifted", size=lambda size: size)
def lifted(size: float) -> float:
    return size


def memory(kind: Kind) -> KindMemory:
    return Settings().make_memories(policies.DEFAULT).of(kind, [])


class Servers:
    """Servers that answer after their `slower` times the usual time, or never if that is 0."""

    def __init__(self, seed: int) -> None:
        self.slower: dict[str, float] = {}
        self.made: list[ScriptedRunner] = []
        self._random = Random(seed)

    def make(self, server: Server) -> ScriptedRunner:
        runner = ScriptedRunner(server.site, lambda one: self.execution(server.site, one))
        self.made.append(runner)
        return self.measure(runner)

    def measure(self, runner: ScriptedRunner) -> ScriptedRunner:
        runner.measured = Condition(TRIP_S, silent=self.slower.get(runner.site) == 0.0)
        return runner

    def onboard(self) -> ScriptedRunner:
        return ScriptedRunner(ONBOARD, lambda one: self.execution(ONBOARD, one))

    def execution(self, site: str, one: Task) -> Execution:
        run_s = (ONBOARD_S if site == ONBOARD else RUN_S) * one.size
        run_s *= self.slower.get(site, 1.0) * self._random.uniform(1 - NOISE, 1 + NOISE)
        if run_s == 0.0:
            return Execution(site, TIMEOUT_S, failure=CloudTimeout("late"), censored=True)
        seconds = run_s + (0.0 if site == ONBOARD else TRIP_S)
        return Execution(site, seconds, one.args[0], queue_s=0.0, run_s=run_s)

    def oracle_s(self, size: float) -> float:
        """The mean time on the best server, without noise."""
        return TRIP_S + RUN_S * size * min(factor for factor in map(self._factor, GROUP) if factor)

    def _factor(self, site: str) -> float:
        return self.slower.get(site, 1.0)


def waited_s(record: Record) -> float:
    """How long the caller waited: for the first answer, after the runs that failed before it."""
    failed_s = sum(one.seconds for one in record.executions if not one.ok)
    return failed_s + min(one.seconds for one in record.executions if one.ok)


def play(seed: int, phases: Sequence[dict[str, float]]) -> tuple[list[Record], float]:
    """The records of TASKS tasks in each phase, and what the oracle needs for all of them, in seconds."""
    servers, records, random, oracle_s = Servers(seed), list[Record](), Random(seed), 0.0
    sites = PresentSites([servers.onboard()], roster=Roster(seed=seed), connect=servers.make)
    sites.follow(Server(site, f"tcp://{site[-1]}.test:5555") for site in GROUP)
    with Offloader(
        sites,
        policy=policies.make(policies.DEFAULT),
        memories=Settings().make_memories(policies.DEFAULT),
        observers=[records.append],
    ) as offload:
        for slower in phases:
            servers.slower = slower
            for number in range(TASKS):
                size = random.uniform(0.8, 1.2)
                oracle_s += servers.oracle_s(size)
                offload(lifted, size)
                if number == HEARTBEAT_TASKS:  # only now the heartbeats show that a server is silent
                    for runner in servers.made:
                        servers.measure(runner)
    return records, oracle_s


@pytest.mark.parametrize("seed", range(5))
def test_one_of_four_servers_fails_and_comes_back(seed: int) -> None:
    """One is slow, dead, and back: the mean is within 5 % of the oracle, and at most 5 % are probes."""
    site = GROUP[seed % len(GROUP)]
    records, oracle_s = play(seed, [{}, {site: 5.0}, {site: 0.0}, {}])
    took_s = sum(waited_s(record) for record in records)
    probes = sum(isinstance(record.decision.second, Probe) for record in records)
    print(f"mean {took_s / oracle_s - 1:+.1%} of the oracle, {probes / len(records):.1%} probes")
    assert took_s <= 1.05 * oracle_s
    assert probes <= 0.05 * len(records)


def test_one_server_of_a_group_is_warmed_up_for_all() -> None:
    """The warm-up runs onboard and on one server; then all four have a prediction."""
    records, _ = play(1, [{}])
    warm = records[:WARM_UP]
    assert len({one.site for record in warm for one in record.executions}) == 2
    assert all(outlook.observations >= WARM_UP for outlook in records[WARM_UP].sites.values())


def test_equal_servers_take_turns_to_be_probed() -> None:
    """Of four servers and onboard, each is probed a quarter as often as the only server would be."""
    for age, probed in ((4 * PROBE_EVERY - 1, False), (4 * PROBE_EVERY, True)):
        sites = {ONBOARD: known(1.0), **{site: known(0.1) for site in GROUP}}
        sites[GROUP[2]] = known(0.2, age=age)
        assert (decide("probe:greedy", sites).second == Probe(GROUP[2])) == probed


def test_the_policy_cloud_uses_the_best_server_of_the_group_cloud() -> None:
    """`--policy cloud` takes the cheapest server of that group, or onboard without any."""
    sites = {ONBOARD: known(0.01), "cloud/a": known(0.3), "cloud/b": known(0.2), "edge": known(0.1)}
    assert decide(CLOUD, sites).site == "cloud/b"
    assert decide(CLOUD, {ONBOARD: known(0.01), "edge": known(0.1)}).site == ONBOARD


def test_memories_of_sites_are_bounded() -> None:
    """Of more sites than REMEMBERED, those that were not used for longest are forgotten, never onboard."""
    found = memory(kind_of(lifted))
    for site in [ONBOARD, *(f"planners/{n}" for n in range(REMEMBERED + 10))]:
        found.site(site).age = 0 if site == ONBOARD else int(site.rpartition("/")[2]) % 50
        found.count_task()
    assert len(found.sites) == REMEMBERED
    assert ONBOARD in found.sites


def test_a_site_that_comes_later_recalls_its_memory(tmp_path: Path) -> None:
    """What the memory file holds of a site is recalled when that site appears, and kept until then."""
    path, kind = tmp_path / "memory", kind_of(lifted)
    known_sites = memory(kind)
    for _ in range(10):
        execution = Execution("gpu", 0.1, 1.0, queue_s=0.0, run_s=0.1)
        known_sites.site("gpu").learn(1.0, execution, None, silent=False, size=1.0)
    Store(path).save_last(Store(path).snapshot({kind.name: known_sites}))
    store, later = Store(path), memory(kind)
    store.recall(later, [ONBOARD])
    assert "gpu" not in later.sites
    assert store.snapshot({kind.name: later})[kind.name].sites.keys() == {"gpu"}
    store.recall(later, [ONBOARD, "gpu"])
    assert later.observations("gpu") == 10
