"""A perception node offloads its callback; a real rclpy peer sends images and gets detections."""

from collections.abc import Callable
from pathlib import Path

import pytest

from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from tests.ros2.conftest import RELEASES, Process

pytestmark = [pytest.mark.ros2, pytest.mark.timeout(120)]

IMAGES = 30


@pytest.mark.parametrize("release", RELEASES)
def test_detections_come_back_from_both_sites(
    release: str,
    start: Callable[..., Process],
    peer: Callable[..., Process],
    testbed: Callable[..., LocalTestbed],
    tmp_path: Path,
) -> None:
    """Every image gets its detection, and during the warm-up both sites compute it."""
    bed = testbed({"tasks": "tests.ros2.spots", "workers": 1}, delay_ms=5.0)
    trace = tmp_path / "trace.jsonl"
    detector = start(release, "-m", "tests.ros2.perception_node", bed.endpoint, str(trace))
    client = peer(release)
    for number in range(IMAGES):
        row, col = 40 + number, 60 + 2 * number
        assert client.do("look", row=row, col=col, stamp=number + 1) == [row, col, number + 1], detector.log()
    assert detector.terminate() == 0, detector.log()
    runs = [run for record in read_trace(trace) for run in (*record["executions"], *record["late"])]
    assert {run["site"] for run in runs if run["ok"]} == {"onboard", "cloud"}
