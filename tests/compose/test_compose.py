"""`docker compose up`: the three processes in real containers."""

import json
import statistics
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from offboard.loadgen.robot_files import read_trace
from tests.compose.conftest import Compose, docker

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

DELAY_S = 0.030  # round trip of the relay
RELAY_S_MAX = 0.003  # the most that everything else may add to an empty task
ROBOT_CPUS = 0.2
PERIOD_US = 10_000
PAIRS = 12
SHARE_TOLERANCE = 0.15


def get(url: str, token: str = "") -> tuple[int, str]:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=5) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, ""


def token_of(up: Compose) -> str:
    return up("exec", "-T", "cloud", "cat", "/token/token").strip()


def test_the_robot_finishes_and_the_table_is_printed(up: Compose, tmp_path: Path) -> None:
    """The robot and the table exit with 0, both print their results, and the trace is complete."""
    assert up.exit_code("robot") == 0, up("logs", "robot")
    assert up.exit_code("table") == 0, up("logs", "table")
    assert "80 tasks answered" in up("logs", "robot")
    assert "| oracle" in up("logs", "table")
    docker("cp", f"{up('ps', '-aq', 'robot').strip()}:/out/trace.jsonl", str(tmp_path))
    records = list(read_trace(tmp_path / "trace.jsonl"))
    assert len(records) == 80
    assert all(record["used"] for record in records)
    assert sum(record["decision"]["both"] for record in records) == 60


def test_the_server_stays_up_after_the_robot(up: Compose) -> None:
    """After the robot has ended, the HTTP API answers on the host; most of it needs the token."""
    up.exit_code("robot")
    token = token_of(up)
    assert json.loads(get(f"{up.url}/health")[1]) == {"healthy": True, "insecure": False}
    assert json.loads(get(f"{up.url}/health", token)[1])["version"]
    assert get(f"{up.url}/ready")[0] == 200
    assert get(f"{up.url}/metrics")[0] == 401
    answered = 'offboard_server_requests_total{kind="plan_path",status="ok"}'
    assert answered in get(f"{up.url}/metrics", token)[1]
    assert "plan_path" in [one["name"] for one in json.loads(get(f"{up.url}/tasks", token)[1])]


def test_the_robot_can_reach_the_cloud_only_through_the_relay(up: Compose) -> None:
    """From the network of the robot, the cloud has no name, and its address cannot be reached."""
    containers = {service: up("ps", "-aq", service).strip() for service in ("cloud", "wan")}
    networks = {
        service: json.loads(docker("inspect", "-f", "{{json .NetworkSettings.Networks}}", container))
        for service, container in containers.items()
    }
    (address,) = (network["IPAddress"] for network in networks["cloud"].values())
    assert len(networks["wan"]) == 2
    reach = (
        "import socket, sys\n"
        "socket.create_connection(('wan', 5555), 3).close()\n"
        f"for host in ('cloud', '{address}'):\n"
        "    try:\n"
        "        socket.create_connection((host, 5555), 3)\n"
        "        sys.exit(f'{host} can be reached')\n"
        "    except OSError as error:\n"
        "        print(host, error)\n"
    )
    lines = up("run", "--rm", "--no-deps", "--entrypoint", "python3", "probe", "-c", reach).splitlines()
    assert len(lines) == 2


def test_an_empty_task_takes_the_links_round_trip(up: Compose) -> None:
    """The median empty task takes at least 30 ms, and without a CPU quota the quickest tenth at most 33 ms.

    Other load of the machine makes the other ones later.
    """
    up.exit_code("robot")
    free = json.loads(up("run", "--rm", "--no-deps", "probe"))
    held = json.loads(up("run", "--rm", "--no-deps", "held-probe"))
    median, median_held = statistics.median(free), statistics.median(held)
    quick = statistics.quantiles(free, n=10)[0]
    print(f"empty tasks: median {median * 1e3:.2f} ms, quickest tenth {quick * 1e3:.2f} ms", end="; ")
    print(f"median under the quota {median_held * 1e3:.2f} ms")
    assert median >= DELAY_S
    assert quick <= DELAY_S + RELAY_S_MAX


def test_the_quota_slows_long_plans_by_its_share(up: Compose) -> None:
    """A long plan takes its CPU time divided by the quota: at least -15 % in the median, +15 % at best.

    Each pair runs in one process, first without and then with the quota. Other load on the machine makes the
    CPU time longer (cold caches) and adds waits; neither depends on the quota.
    """
    up.exit_code("robot")
    held_us = int(ROBOT_CPUS * PERIOD_US)
    with up.running("held-probe", "tests.compose.long_plans") as (container, ask):
        assert ask()["quota_us"] == [held_us, PERIOD_US], "the quota asked for in docker-compose.yml"
        pairs = []
        for _ in range(PAIRS):
            pair = []
            for quota_us in (-1, held_us):
                docker("update", f"--cpu-period={PERIOD_US}", f"--cpu-quota={quota_us}", container)
                pair.append(ask())
                assert pair[-1]["quota_us"] == [quota_us, PERIOD_US]
            pairs.append(pair)
    assert statistics.median(held["cpu_s"] for _, held in pairs) >= 10 * held_us / 1e6, "too short"
    free, held = ([pair[i]["seconds"] / pair[i]["cpu_s"] for pair in pairs] for i in (0, 1))
    free_ms, held_ms = (statistics.median(pair[i]["seconds"] for pair in pairs) * 1e3 for i in (0, 1))
    usual = statistics.median(held)
    print(
        f"long plan: {free_ms:.1f} ms free; {held_ms:.1f} at {ROBOT_CPUS} CPU, {usual:.2f} times its CPU time"
    )
    assert min(free) < 1 / ROBOT_CPUS / 2, "without a quota, nothing slows the plan"
    assert usual > (1 - SHARE_TOLERANCE) / ROBOT_CPUS
    assert min(held) < (1 + SHARE_TOLERANCE) / ROBOT_CPUS, "other load can only make it longer"


def test_the_cloud_has_its_own_quota(up: Compose) -> None:
    """The container of the server has a quota of one CPU over 10 ms."""
    container = up("ps", "-q", "cloud").strip()
    limits = json.loads(docker("inspect", "-f", "{{json .HostConfig}}", container))
    assert (limits["CpuQuota"], limits["CpuPeriod"], limits["NanoCpus"]) == (10_000, 10_000, 0)
    user = docker("exec", container, "id", "-u")
    assert user != "0"


def test_the_relay_can_be_read_and_changed_from_the_host(up: Compose) -> None:
    """GET /link with the token returns the conditions of the link; without the token it is refused."""
    link = json.loads(get(f"{up.wan_url}/link", token_of(up))[1])
    assert link["up"]["delay_ms"] == link["down"]["delay_ms"] == 15.0
    assert get(f"{up.wan_url}/link")[0] == 401


@pytest.mark.parametrize("service", ["keys", "cloud", "wan", "robot", "table"])
def test_containers_have_few_rights(up: Compose, service: str) -> None:
    """A container has no root user, no capabilities, a read-only disk, and limits on memory and processes."""
    (found,) = json.loads(docker("inspect", up("ps", "-aq", service).strip()))
    host = found["HostConfig"]
    assert found["Config"]["User"] == "offboard"
    assert (host["ReadonlyRootfs"], host["CapDrop"], host["Privileged"]) == (True, ["ALL"], False)
    assert "no-new-privileges:true" in host["SecurityOpt"]
    assert host["Memory"] > 0
    assert host["PidsLimit"] > 0


@pytest.mark.parametrize("image", ["offboard-cloud", "offboard-robot", "offboard-bench"])
def test_images_have_no_compiler(up: Compose, image: str) -> None:  # noqa: ARG001 - builds the images
    """An attacker in a container finds no compiler."""
    tools = "cc gcc g++ c++ clang tcc make ld as"
    look = f"for tool in {tools}; do command -v $tool || true; done"
    assert docker("run", "--rm", "--network", "none", "--entrypoint", "sh", image, "-c", look).split() == []


def test_the_robot_knows_only_the_public_key_of_the_server(up: Compose) -> None:
    """The robot has its own key pair and the public key of the server, and the server knows the robot."""
    list_keys = "from pathlib import Path; print(*sorted(path.name for path in Path('/keys').iterdir()))"
    names = up("run", "--rm", "--no-deps", "--entrypoint", "python3", "probe", "-c", list_keys).split()
    assert names == ["robot.key", "robot.key_secret", "server.key"]
    assert "robots known: robot" in up("logs", "cloud")
