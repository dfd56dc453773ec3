"""A server on a Ray cluster, and what robots and operators see when nodes or the head are lost."""

import json
import threading
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from offboard import Offloader
from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Plan, Point, Pose, plan_path
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.ray.clusters import RayNodes
from tests.ray.servers import RayServer, until

pytestmark = [pytest.mark.integration, pytest.mark.timeout(300)]

PLANS = 1000
GOALS = 20
CELLS = 200
WAIT_S = 60.0
SEED = 36


def problems() -> tuple[GridMap, list[tuple[Pose, Point]]]:
    """A map with random obstacles, and ways across it."""
    drawn = np.random.default_rng(SEED)
    cells = np.where(drawn.random((CELLS, CELLS)) < 0.1, 100, 0).astype(np.int8)
    cells.flags.writeable = False
    ways = drawn.uniform(1, CELLS - 1, (GOALS, 4)).tolist()
    return GridMap(cells, 1.0), [(Pose(x, y), Point(to_x, to_y)) for x, y, to_x, to_y in ways]


def test_no_plan_is_lost_or_wrong_if_a_node_is_killed(tmp_path: Path, fresh: Callable[..., RayNodes]) -> None:
    """Two robots ask for 1,000 plans; one of two nodes is killed in the middle, with what it runs."""
    cluster, records = fresh(2), list[Record]()
    server = RayServer(tmp_path, "--ray-address", cluster.address, "--workers", "2")
    grid, ways = problems()
    expected = [plan_path(grid, None, *way) for way in ways]
    middle = threading.Event()

    def ask(offload: Offloader, number: int) -> Plan:
        if number == PLANS // 2:
            middle.set()
        return offload(plan_path, grid, None, *ways[number % GOALS], where=CLOUD)

    def kill() -> None:
        assert middle.wait(WAIT_S)
        cluster.kill(cluster.nodes[0])

    killer = threading.Thread(target=kill)
    killer.start()
    with Offloader.connect(server.endpoint, observers=[records.append]) as offload:
        assert not offload.wait_for_sites(plan_path, WAIT_S)
        with ThreadPoolExecutor(2) as robots:
            answers = list(robots.map(lambda number: ask(offload, number), range(PLANS)))
    killer.join(WAIT_S)
    wrong = sum(
        answer.cost != expected[number % GOALS].cost or answer.status != expected[number % GOALS].status
        for number, answer in enumerate(answers)
    )
    sites = Counter(record.used for record in records)
    print(f"{len(answers)} plans, {wrong} wrong, answered by {dict(sites)}")
    assert (len(answers), wrong) == (PLANS, 0)
    assert sites[CLOUD] > PLANS // 2
    assert sites[CLOUD] + sites[ONBOARD] == PLANS
    assert "was lost with its node" in server.log or "its node does not answer" in server.log
    assert server.close() == 0


def test_without_its_head_the_server_is_not_ready(tmp_path: Path, fresh: Callable[..., RayNodes]) -> None:
    """Robots then use another site. Before that, the pages name the executor and where its workers are."""
    cluster = fresh(1)
    server = RayServer(tmp_path, "--ray-address", cluster.address, "--workers", "1")
    health = server.health()
    assert (health["executor"], health["ready"]) == ("ray", True)
    assert isinstance(health["places"], dict)
    assert sum(health["places"].values()) == 1
    assert 'offboard_server_up_workers{executor="ray"} 1.0' in server.get("/metrics")[1]
    assert json.loads(server.get("/config")[1])["executor"] == "ray"
    assert '"executor":"ray","places":{' in server.get("/live/looks")[1]
    assert server.get("/ready")[0] == 200
    with Offloader.connect(server.endpoint) as offload:
        grid, ways = problems()
        assert not offload.wait_for_sites(plan_path, WAIT_S)
        cluster.kill_head()
        until(lambda: server.get("/ready")[0] == 503)
        assert (
            offload(plan_path, grid, None, *ways[0], where=CLOUD).cost == plan_path(grid, None, *ways[0]).cost
        )
    assert "the head of the Ray cluster does not answer" in server.log
    assert server.health()["healthy"]
    server.close()


def test_a_new_head_at_the_same_address_is_used(tmp_path: Path, fresh: Callable[..., RayNodes]) -> None:
    """After all nodes were lost, the server connects to the new cluster and is ready again."""
    cluster = fresh(1)
    server = RayServer(tmp_path, "--ray-address", cluster.address, "--workers", "1")
    cluster.kill_all()
    until(lambda: server.get("/ready")[0] == 503)
    fresh(1, gcs_server_port=int(cluster.address.rpartition(":")[2]))
    until(lambda: server.get("/ready")[0] == 200)
    grid, ways = problems()
    with Offloader.connect(server.endpoint) as offload:
        assert not offload.wait_for_sites(plan_path, WAIT_S)
        assert (
            offload(plan_path, grid, None, *ways[0], where=CLOUD).cost == plan_path(grid, None, *ways[0]).cost
        )
    assert server.close() == 0
