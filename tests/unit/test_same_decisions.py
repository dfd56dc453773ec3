"""Replay against the run, task by task: the policy of the run decides as it did there."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import pytest

from offboard.common.errors import DataError
from offboard.loadgen.replay.recorded_tasks import RecordedTask, read_tasks
from offboard.loadgen.replay.replay import tables
from offboard.loadgen.replay.replay_settings import ReplayConfig
from offboard.loadgen.replay.virtual_robot import VirtualRobot, compare, same
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario
from offboard.loadgen.simulation.model.task_costs import RobotTasks, find_tasks
from offboard.loadgen.simulation.simulated_run import simulate
from offboard.robot_client import policies
from offboard.robot_client.policies import Decision, Hedge, Probe
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.mazes import warm

warm()

Simulated = Callable[..., Path]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    """Simulates a scenario and returns the trace of its robot; each scenario makes its tasks once a seed."""
    known: dict[tuple[str, int], dict[str, RobotTasks]] = {}

    def factory(name: str, policy: str, seed: int = 1, *, measure_all: bool = False) -> Path:
        scenario = read_scenario(find_scenario(name)).changed(
            policy=policy, seed=seed, measure_all=measure_all
        )
        if (name, seed) not in known:
            workload = scenario.workload
            known[name, seed] = {
                robot: find_tasks(workload, seed, workload.tasks) for robot in scenario.robots()
            }
        path = tmp_path_factory.mktemp("run") / "trace.jsonl"
        trace = Trace(path)
        simulate(scenario, known[name, seed], trace=trace)
        trace.close()
        path.with_name("summary.json").write_text(json.dumps({"decided_by": asdict(scenario.decided_by)}))
        return path

    return factory


def same_percent(path: Path, policy: str) -> float:
    (table,) = tables(path, ReplayConfig(policies=(policy,), window=20))
    (line,) = [line for line in table.lines if line.policy == policy]
    assert line.same_percent is not None
    found: float = line.same_percent
    return found


@pytest.mark.parametrize("policy", ["default", "paper"])
@pytest.mark.parametrize("name", ["calm", "outage", "heavy-tail", "burst"])
def test_the_policy_of_the_run_decides_as_in_the_run(simulated: Simulated, name: str, policy: str) -> None:
    """At least 99 % of the decisions are equal: site, second site and when it starts."""
    assert same_percent(simulated(name, policy), policy) >= 99


@pytest.mark.parametrize("name", ["deadline", "p95", "battery", "metered"])
def test_the_objective_of_the_run_decides_as_in_the_run(simulated: Simulated, name: str) -> None:
    """A replay weighs what the run weighed; with POLICY+OBJECTIVE, it decides otherwise."""
    path = simulated(name, "default")
    assert same_percent(path, "default") >= 99
    assert same_percent(path, "default+mean") < same_percent(path, "default") - 3


def test_another_policy_decides_otherwise(simulated: Simulated) -> None:
    """The comparison tells policies apart: the published rule stays away from the cloud after an outage."""
    path = simulated("outage", "default")
    assert same_percent(path, "onboard") < 80
    assert same_percent(path, "greedy") < same_percent(path, "default")


def test_a_robot_that_starts_again_knows_nothing(simulated: Simulated, tmp_path: Path) -> None:
    """In a trace of two processes, the second one begins with a warm-up, and so does its replay."""
    path = tmp_path / "trace.jsonl"
    path.write_text("".join(simulated("heavy-tail", "default", seed).read_text() for seed in (1, 2)))
    assert same_percent(path, "default") >= 99


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ('"waited_s":', '"waited_s":null,"was":', "TypeError"),
        ('"seconds":', '"seconds":-1,"was":', "-1.0 is not a finite number"),
        ('"decision":{"site":"', '"decision":{"site":"moon","was":"', "'moon' is not one of its sites"),
        ('"timeout_s":', '"timeout_s":0,"was":', "timeout_s 0: must be a number above 0"),
        ('"onboard.capacity":', '"onboard.capacity":0,"was":', "onboard.capacity is 0"),
    ],
)
def test_a_line_that_cannot_be_replayed_is_named(
    simulated: Simulated, tmp_path: Path, old: str, new: str, error: str
) -> None:
    """A wrong value is an error with file and line."""
    path = tmp_path / "trace.jsonl"
    first, second, *_ = simulated("calm", "default").read_text().splitlines(keepends=True)
    path.write_text(first + second.replace(old, new))
    with pytest.raises(DataError, match=r"trace\.jsonl:2: cannot be replayed: ") as raised:
        read_tasks(path, None)
    assert error in str(raised.value)


def test_servers_may_change_during_a_run() -> None:
    """The replay knows each server that any task could use, also if no task could use all of them."""
    tasks = [
        RecordedTask(
            1.0,
            {server: Execution(server, 0.1)},
            sites=(ONBOARD, server),
            decision=Decision(server, "", "greedy"),
            i=i,
            started_s=float(i),
            waited_s=0.1,
        )
        for i, server in enumerate(("one", "other"))
    ]
    known: list[Sequence[str]] = []

    def make(sites: Sequence[str]) -> VirtualRobot:
        known.append(sites)
        memories = Settings().make_memories("default")
        return VirtualRobot(policies.make("greedy", 0), memories, tells_work=False, sites=sites)

    assert [task for task, _ in compare(tasks, make)] == tasks
    assert known == [(ONBOARD, "one", "other")]


def test_decisions_are_equal_if_they_start_the_same_sites_at_the_same_time() -> None:
    """A hedge may come a twentieth later; a probe is not a hedge, and another site is another decision."""

    def sent(site: str = CLOUD, second: Probe | Hedge | None = None, *, both: bool = False) -> Decision:
        return Decision(site, "", "p", both=both, second=second)

    assert same(sent(second=Hedge(ONBOARD, 1.0)), sent(second=Hedge(ONBOARD, 1.04)))
    assert not same(sent(second=Hedge(ONBOARD, 1.0)), sent(second=Hedge(ONBOARD, 1.1)))
    assert not same(sent(second=Hedge(ONBOARD, 1.0)), sent())
    assert not same(sent(second=Probe(ONBOARD)), sent(second=Hedge(ONBOARD, 0.1)))
    assert not same(sent(CLOUD), sent(ONBOARD))
    assert not same(sent(ONBOARD), sent(ONBOARD, both=True))
