"""`docker compose --profile observe up`: a Prometheus next to the three containers."""

import json
import urllib.request
from collections.abc import Iterator

import pytest

from tests.compose.conftest import PROMETHEUS_PORT, ROBOT_METRICS_PORT, Compose, docker
from tests.prometheus import Prometheus, until

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

PROFILE = ("--profile", "observe")


@pytest.fixture(scope="module")
def prometheus(up: Compose) -> Iterator[Prometheus]:
    """The Prometheus of the profile; the robot drives again while it runs."""
    up.exit_code("robot")
    up(*PROFILE, "up", "--detach", "--build", "--no-deps", "prometheus")
    seen = Prometheus(f"127.0.0.1:{PROMETHEUS_PORT}")
    until(lambda: seen.answers("up"), "Prometheus has scraped")
    up("start", "robot")
    yield seen
    up(*PROFILE, "down", "--volumes", "--remove-orphans")


def test_prometheus_scrapes_robot_and_cloud(prometheus: Prometheus) -> None:
    """It reads the server with the token, and the robot while it drives; the host can read the robot too."""
    until(lambda: prometheus.values('up{job="offboard-server"}') == [1.0], "the server is scraped")
    address = f"http://127.0.0.1:{ROBOT_METRICS_PORT}/metrics"
    until(lambda: "offboard_robot_tasks_total{" in _read(address), "the metrics of the robot")
    counted = "sum(count_over_time(offboard_robot_tasks_total[10m])) > 0"
    until(lambda: prometheus.values(counted) != [], "the robot is scraped")


def test_prometheus_has_the_rules(prometheus: Prometheus) -> None:
    """All rules are loaded, and none has an error."""
    rules = [rule for group in prometheus.ask("rules")["groups"] for rule in group["rules"]]
    assert {"OffboardCloudSilent", "OffboardServerDown"} <= {rule["name"] for rule in rules}
    until(lambda: _health(prometheus) == {"ok"}, "each rule was evaluated")


def test_prometheus_has_few_rights(up: Compose, prometheus: Prometheus) -> None:  # noqa: ARG001 - starts it
    """Its container runs as the user `offboard`, with a read-only disk and no capability."""
    container = up(*PROFILE, "ps", "-q", "prometheus").strip()
    (found,) = json.loads(docker("inspect", container))
    host = found["HostConfig"]
    assert found["Config"]["User"] == "offboard"
    assert (host["ReadonlyRootfs"], host["CapDrop"], host["Privileged"]) == (True, ["ALL"], False)


def _health(prometheus: Prometheus) -> set[str]:
    return {rule["health"] for group in prometheus.ask("rules")["groups"] for rule in group["rules"]}


def _read(address: str) -> str:
    """What is served there; empty while nothing is."""
    try:
        with urllib.request.urlopen(address, timeout=5) as answer:
            return str(answer.read().decode())
    except OSError:
        return ""
