"""The names of metrics in rules and documentation are those that robot and server serve."""

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from prometheus_client import CollectorRegistry

from offboard.cloud_server.metrics import Metrics as ServerMetrics
from offboard.robot_client.learning.regret import Regret
from offboard.robot_client.records.metrics import Metrics as RobotMetrics
from offboard.robot_client.records.trace import Trace
from offboard.robot_client.streams.counts import StreamMetrics
from tests.unit.test_trace import record

ROOT = Path(__file__).parents[2]
RULES = ROOT / "deploy" / "prometheus"
PAGE = ROOT / "common" / "live" / "static"
USERS = list(RULES.glob("*.rules.yml")), list(PAGE.glob("*.js"))
NAME = re.compile(r"(?<![\w:])offboard_(?:robot|server)_\w+")


def served(registry: CollectorRegistry) -> Iterable[str]:
    """The names of all samples, and of metrics without samples yet, as Prometheus reads them."""
    for metric in registry.collect():
        ends = {"counter": ["_total"], "histogram": ["_bucket", "_sum", "_count"]}.get(metric.type, [""])
        yield from (metric.name + end for end in ends)


def all_served(folder: Path) -> set[str]:
    registry = CollectorRegistry()
    robot, trace = RobotMetrics(registry), Trace(folder / "trace.jsonl")
    robot.watch(trace)
    robot.show(StreamMetrics())
    robot(replace(record(0), regret=Regret(0.01, 0.004, 0.02, 9)))
    trace.close()
    return {*served(registry), *served(ServerMetrics().registry)}


def test_rules_and_the_live_page_use_only_metrics_that_exist(tmp_path: Path) -> None:
    """A rule, or a figure of the page, on a name that nobody serves would never have a value."""
    rules, page = ({name for path in paths for name in NAME.findall(path.read_text())} for paths in USERS)
    assert min(len(rules), len(page)) > 5
    assert (rules | page) - all_served(tmp_path) == set()


def test_the_documentation_lists_each_metric_and_no_other(tmp_path: Path) -> None:
    """A histogram is listed without the endings that Prometheus adds."""
    pages = (ROOT / "docs" / name for name in ("robot.md", "server.md"))
    listed = {name for page in pages for name in NAME.findall(page.read_text())}
    wanted = {re.sub(r"_(bucket|sum|count)$", "", name) for name in all_served(tmp_path)}
    assert listed == wanted
