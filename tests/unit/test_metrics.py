"""The metrics of the robot."""

from collections import UserDict
from dataclasses import replace

import pytest
from prometheus_client import CollectorRegistry

from offboard.common.errors import CloudBroken
from offboard.robot_client.learning.regret import Regret
from offboard.robot_client.policies import Outlook
from offboard.robot_client.records.metrics import GONE_MAX, Metrics
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition, Execution
from tests.fakes import ScriptedRunner
from tests.unit.test_trace import record


def test_a_record_is_counted_once_by_site_and_outcome() -> None:
    """A task that fails in the cloud and is answered onboard is one task, two executions and one wait."""
    registry = CollectorRegistry()
    observe = Metrics(registry)
    observe(record(0))
    observe(replace(record(1), used=None))

    def value(name: str, **labels: str) -> float | None:
        return registry.get_sample_value(name, {"kind": "plan_path", **labels})

    assert value("offboard_robot_tasks_total", site=ONBOARD) == 1
    assert value("offboard_robot_tasks_total", site="none") == 1
    assert value("offboard_robot_executions_total", site=CLOUD, outcome="CloudTimeout") == 2
    assert value("offboard_robot_executions_total", site=ONBOARD, outcome="ok") == 2
    assert value("offboard_robot_wait_seconds_sum") == 4.2
    assert value("offboard_robot_predicted_seconds", site=ONBOARD) == 0.1
    assert value("offboard_robot_predicted_seconds", site=CLOUD) is None
    assert value("offboard_robot_decisions_total", site=CLOUD, policy="paper") == 2
    assert value("offboard_robot_duplicate_executions_total") == 2


@pytest.mark.parametrize(
    ("seconds", "inside"), [(0.079, "false"), (0.08, "true"), (0.15, "true"), (0.2, "false")]
)
def test_answers_count_as_inside_or_outside_their_interval(seconds: float, inside: str) -> None:
    """Failures, and sites without an interval, do not count."""
    registry = CollectorRegistry()
    observe = Metrics(registry)
    for failure in (None, CloudBroken("gone")):
        runs = (
            Execution(ONBOARD, seconds, failure=failure),
            Execution(CLOUD, seconds),
            Execution("edge", seconds),
        )
        observe(replace(record(0), executions=runs))
    found = next(one for one in registry.collect() if one.name == "offboard_robot_interval_checks").samples
    assert {
        (one.labels["site"], one.labels["inside"]): one.value for one in found if one.name.endswith("total")
    } == {(ONBOARD, inside): 1.0}


def test_regret_is_the_last_estimate() -> None:
    """The mean and both ends of its interval are shown. Before the first estimate they do not exist."""
    registry = CollectorRegistry()
    observe = Metrics(registry)
    observe(replace(record(0), regret=None))
    assert registry.get_sample_value("offboard_robot_regret_seconds") is None
    for mean_s in (0.5, 0.01):
        observe(replace(record(0), regret=Regret(mean_s, 0.004, 0.02, 9)))
    observe(replace(record(0), regret=None))
    names = [f"offboard_robot_regret{end}_seconds" for end in ("", "_low", "_high")]
    assert [registry.get_sample_value(name) for name in names] == [0.01, 0.004, 0.02]


def test_a_site_that_is_silent_or_absent_is_not_usable() -> None:
    """A site shows 1 while it answers, and 0 while it does not; also if it never has. Onboard shows 1."""
    registry = CollectorRegistry()
    observe = Metrics(registry)
    observe.live.show(
        {site: ScriptedRunner(site, lambda _: Execution(CLOUD, 0.1)) for site in (CLOUD, "edge")},
        allowance=None,
    )

    def usable() -> list[float | None]:
        name, kind = "offboard_robot_site_usable", {"kind": "plan_path"}
        return [registry.get_sample_value(name, {**kind, "site": site}) for site in (ONBOARD, CLOUD, "edge")]

    assert usable() == [None, None, None], "nothing is known before the first task"
    answering, silent = Outlook(), Outlook(condition=Condition(None, silent=True))
    for sites, cloud in (({CLOUD: answering}, 1), ({CLOUD: silent}, 0), ({CLOUD: answering}, 1), ({}, 0)):
        observe(replace(record(0), sites={ONBOARD: answering, **sites}))
        assert usable() == [1, cloud, 0]


def test_the_metrics_of_servers_that_left_are_bounded() -> None:
    """The last ones are not usable any more and keep their counts; all metrics of older ones are removed."""
    registry = CollectorRegistry()
    observe = Metrics(registry)
    servers = [f"server-{n}" for n in range(GONE_MAX + 3)]
    for server in servers:
        observe.live.show({server: ScriptedRunner(server, lambda _: Execution(CLOUD, 0.1))}, allowance=None)
        outlook = Outlook(0.1, low_s=0.0, high_s=1.0)
        decision = record(0).decision._replace(site=server)
        runs = (Execution(server, 0.1),)
        sites = {server: outlook}
        observe(replace(record(0), used=server, sites=sites, executions=runs, decision=decision))

    samples = [one for family in registry.collect() for one in family.samples if "site" in one.labels]
    assert {one.labels["site"] for one in samples} == set(servers[2:])
    usable = {one.labels["site"]: one.value for one in samples if one.name == "offboard_robot_site_usable"}
    assert usable == {**dict.fromkeys(servers[2:], 0), servers[-1]: 1}


def test_a_server_may_leave_while_a_task_is_counted() -> None:
    """The names of the sites are read, and never looked up: the next look may be without one of them."""

    class Leaving(UserDict[str, ScriptedRunner]):
        def __getitem__(self, site: str) -> ScriptedRunner:
            raise KeyError(site)

    observe = Metrics(CollectorRegistry())
    there = {"edge": ScriptedRunner("edge", lambda _: Execution("edge", 0.1))}
    observe.live.show(Leaving(there), allowance=None)
    observe(record(0))
