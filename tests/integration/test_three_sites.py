"""Three real sites fail in turn: onboard, an edge server nearby, and a faster cloud further away."""

import contextlib
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from random import Random

import pytest

from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.loadgen.testbed.testbed import Setup
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import DEFAULT
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests import slow_site
from tests.phases import EDGE, PHASES, TASKS, check

pytestmark = [pytest.mark.integration, pytest.mark.timeout(150)]

EDGE_CPUS, EDGE_DELAY_MS = 0.3, 5.0
CLOUD_CPUS, CLOUD_DELAY_MS = 2 * EDGE_CPUS, 40.0
RUN_S = (0.009, 0.015)  # CPU time of a server for a task, drawn evenly
TRIED_ROUNDS, TRIES = 20_000, 9
ONBOARD_TIMES, SLOWED_TIMES = 15, 150  # times the work of a server: normal, and ten times slower
TIMEOUT_S = 0.5
CONNECT_S = 20.0


@pytest.fixture
def servers(tmp_path: Path) -> Iterator[dict[str, LocalTestbed]]:
    """Edge and cloud, each a server behind its own relay."""
    with contextlib.ExitStack() as stack:
        beds = {}
        for site, cpus, delay_ms in ((EDGE, EDGE_CPUS, EDGE_DELAY_MS), (CLOUD, CLOUD_CPUS, CLOUD_DELAY_MS)):
            setups = {
                "cloud": Setup({"tasks": "tests.slow_site", "workers": 1}, cpus),
                "wan": Setup({"delay_ms": delay_ms}),
            }
            beds[site] = stack.enter_context(LocalTestbed(tmp_path / site, setups))
            beds[site].start()
        yield beds


def rounds_a_second() -> float:
    """The speed of this machine, so that the best site is the same on fast and slow machines."""
    took_s = []
    for _ in range(TRIES):
        began_s = time.thread_time()
        slow_site.hash_slowly(TRIED_ROUNDS)
        took_s.append(time.thread_time() - began_s)
    return TRIED_ROUNDS / min(took_s)


def fail(servers: Mapping[str, LocalTestbed], failing: tuple[str, ...]) -> None:
    """The edge crashes, the link of the cloud is cut, or onboard becomes ten times slower."""
    if EDGE in failing:
        servers[EDGE].kill("cloud")
    elif not servers[EDGE].running("cloud"):
        servers[EDGE].start("cloud")
    servers[CLOUD].set_link(outage=CLOUD in failing)
    slow_site.times = SLOWED_TIMES if ONBOARD in failing else ONBOARD_TIMES


def test_the_best_remaining_site_is_used_within_thirty_tasks(
    servers: dict[str, LocalTestbed], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The default policy finds it after each change, and no task is lost."""
    rounds = [round(run_s * rounds_a_second()) for run_s in RUN_S]
    monkeypatch.setattr(slow_site, "times", ONBOARD_TIMES)
    random, records = Random(1), list[Record]()
    endpoints = {site: bed.endpoint for site, bed in servers.items()}
    with Offloader.connect(
        sites=endpoints, policy=DEFAULT, timeout_s=TIMEOUT_S, observers=[records.append]
    ) as offload:
        assert offload.wait_for_sites(slow_site.hash_slowly, CONNECT_S) == {}
        for failing, _ in PHASES:
            fail(servers, failing)
            for _ in range(TASKS):
                assert offload(slow_site.hash_slowly, random.randint(*rounds))
    check(records)
