"""A real Prometheus that scrapes a robot and its server, before, in and after an outage."""

import logging
import re
import threading
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest

from offboard.robot_client.offloader import Offloader
from tests.probes import echo
from tests.prometheus import until

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]

PAUSE_S = 0.05
ALERT = "OffboardCloudSilent"


class Working:
    """A robot that asks for a task every PAUSE_S, and serves its metrics at `address`."""

    def __init__(self, offload: Offloader, address: str) -> None:
        self.address = address
        self._offload, self._ended = offload, threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(PAUSE_S):
            self._offload(echo, 1)

    def end(self) -> None:
        self._ended.set()
        self._thread.join(10.0)


@pytest.fixture
def bed(testbed: Any) -> Any:
    return testbed()


@pytest.fixture
def robot(bed: Any, connect: Any, caplog: pytest.LogCaptureFixture) -> Iterator[Working]:
    """A robot on the testbed that works until the end of the test."""
    caplog.set_level(logging.INFO, logger="offboard.robot_client.records.metrics")
    offload = connect(bed, metrics="127.0.0.1:0", timeout_s=0.5)
    found = re.search(r"metrics: http://(127\.0\.0\.1:\d+)/metrics", caplog.text)
    assert found is not None
    working = Working(offload, found[1])
    yield working
    working.end()


def test_metric_names_follow_the_conventions(bed: Any, robot: Working, promtool: Any) -> None:
    """`promtool check metrics` finds nothing to complain about in the metrics of robot and server."""
    wanted = {
        robot.address: ("offboard_robot_predicted_seconds{", 'usable{kind="echo",site="cloud"} 1.0'),
        bed.parts["cloud"].http: ("offboard_server_run_seconds_count{",),
    }
    for address, lines in wanted.items():
        until(lambda at=address, found=lines: all(one in metrics(at) for one in found), str(lines))
        done = promtool("check", "metrics", text=metrics(address))
        assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_cloud_silent_fires_in_an_outage_and_ends_after_it(bed: Any, robot: Working, prometheus: Any) -> None:
    """Prometheus scrapes both sides and computes the rules; the only alert is that of the outage."""
    seen = prometheus(offboard_robot=robot.address, offboard_server=bed.parts["cloud"].http)
    until(lambda: seen.values("sum(up)") == [2.0], "both targets are scraped")
    for rule in ("instance_kind:offboard_robot_wait_seconds:p95_5m", "offboard_server_requests:rate5m"):
        recorded = f'{{__name__=~".*{rule}"}}'
        until(lambda name=recorded: len(seen.values(name)) == 1, rule)
    assert seen.firing() == {}
    bed.set_link(outage=True)
    fired_s = until(lambda: seen.firing(), "the alert fires")
    assert {name: labels["site"] for name, labels in seen.firing().items()} == {ALERT: "cloud"}
    bed.set_link(outage=False)
    ended_s = until(lambda: not seen.firing(), "the alert ends")
    print(f"{ALERT} fired after {fired_s:.1f} s of silence, and ended {ended_s:.1f} s after it")


def metrics(address: str) -> str:
    return urllib.request.urlopen(f"http://{address}/metrics", timeout=5).read().decode()  # type: ignore[no-any-return]
