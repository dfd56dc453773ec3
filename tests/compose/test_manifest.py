"""The pod of deploy/kubernetes, started with Docker exactly as its manifest says."""

import contextlib
import io
import json
import secrets
import subprocess
import tarfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from offboard import Offloader
from offboard.common.planning.map_files import read_map
from offboard.common.planning.maps import free_pairs, resampled
from offboard.common.planning.planner import RADIUS_M, Plan, Point, Pose, plan_path
from offboard.common.security.keys import make_keys
from offboard.robot_client.records.record import Record
from tests.compose.conftest import ROOT, docker
from tests.manifests import Pod
from tests.prometheus import until

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

NAME = "offboard-test-pod"
PLANS = 8
WAITING = 24  # plans that wait or run when the server is stopped
ANSWER_S = 60.0
NOTICED_S = 30.0  # until a new key counts


@dataclass(frozen=True, slots=True)
class Running:
    """A started server: its addresses, the folder of its files, and how long its start took."""

    pod: Pod
    endpoint: str
    http: str
    folder: Path
    ready_s: float


@pytest.fixture(scope="module")
def volumes(engine: None) -> Iterator[dict[str, str]]:  # noqa: ARG001 - skips without an engine
    """An empty Docker volume for each volume of the pod, which belongs to root and to the pod's group."""
    docker("build", "--target", "cloud", "--tag", "offboard-cloud", ".")
    pod = Pod.read()
    names = {volume["name"]: f"{NAME}-{volume['name']}" for volume in pod.spec["volumes"]}
    docker("rm", "--force", NAME)  # of a run that was killed
    with contextlib.ExitStack() as stack:
        for name in names.values():
            docker("volume", "rm", "--force", name)
            docker("volume", "create", name)
            stack.callback(docker, "volume", "rm", "--force", name)
            as_root(name, f"chown 0:{pod.group} /volume && chmod 2777 /volume")
        yield names


@pytest.fixture(scope="module")
def server(volumes: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """The server, started as the kubelet does: volumes, the container that copies, then the server itself."""
    pod, folder = Pod.read(), tmp_path_factory.mktemp("pod")
    make_keys(folder, "server")
    (folder / "token").write_text(secrets.token_hex(32))
    make_robot(folder, "arm-1")
    volume = {one["name"]: one for one in pod.spec["volumes"]}
    mode = f"{volume['secret']['secret']['defaultMode']:04o}"
    project(volumes["secret"], pod, {name: folder / name for name in ("server.key_secret", "token")}, mode)
    project(volumes["robots"], pod, {"arm-1.key": folder / "arm-1" / "robot.key"}, "0644")
    docker("run", "--rm", "--network", "none", *pod.docker_run(pod.copier, volumes))
    ports = ("--publish", "127.0.0.1::5555", "--publish", "127.0.0.1::8000")
    began = time.monotonic()
    docker("run", "--detach", "--name", NAME, *ports, *pod.docker_run(pod.server, volumes))
    try:
        robots, http = (docker("port", NAME, port).splitlines()[0] for port in ("5555", "8000"))
        probe_until_started(pod, f"http://{http}")
        yield Running(pod, f"tcp://{robots}", f"http://{http}", folder, time.monotonic() - began)
    finally:
        docker("rm", "--force", NAME)


def test_it_becomes_ready_within_the_startup_probe(server: Running) -> None:
    """The server compiles on a read-only disk and becomes ready; probes need no token, other paths do."""
    print(f"ready after {server.ready_s:.1f} s")
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert status(server.http + server.pod.server[probe]["httpGet"]["path"]) == 200
    assert status(f"{server.http}/config") == 401
    token = (server.folder / "token").read_text()
    settings = json.loads(read(f"{server.http}/config", token))
    assert settings["workers"] == int(server.pod.server["resources"]["limits"]["cpu"])


def test_it_refuses_the_secret_as_kubernetes_mounts_it(server: Running, volumes: dict[str, str]) -> None:
    """Without the container that copies, the server would refuse the key that the pod's group may read."""
    uncopied = {**volumes, "keys": volumes["secret"]}
    command = ["docker", "run", "--rm", *server.pod.docker_run(server.pod.server, uncopied)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert "other users may access it" in done.stderr


def test_it_answers_plans_of_a_robot_with_a_key(server: Running) -> None:
    """Plans come from the server, over CURVE, and are those that the robot would make itself."""
    with connect(server, "arm-1") as offload:
        for arguments in plans(PLANS):
            plan = offload(plan_path, *arguments)
            assert offload.last is not None
            (execution,) = offload.last.executions
            assert (execution.site, execution.error) == ("cloud", None)
            assert plan.cost == plan_path(*arguments).cost


def test_it_takes_in_a_robot_of_a_changed_config_map(server: Running, volumes: dict[str, str]) -> None:
    """The kubelet replaces the files of the ConfigMap; the server knows the new robot without a restart."""
    make_robot(server.folder, "arm-2")
    keys = {f"{name}.key": server.folder / name / "robot.key" for name in ("arm-1", "arm-2")}
    project(volumes["robots"], server.pod, keys, "0644")
    with connect(server, "arm-2") as offload:
        offload(plan_path, *plans(1)[0])
        assert offload.last is not None
        assert offload.last.used == "cloud"


def test_it_drains_within_the_grace_period(server: Running) -> None:
    """After SIGTERM it answers what it has accepted, and ends with 0 before the kubelet would kill it."""
    grace_s, token = server.pod.spec["terminationGracePeriodSeconds"], (server.folder / "token").read_text()
    used: list[str | None] = []
    arguments = plans(WAITING)
    with connect(server, "arm-1", lambda record: used.append(record.used)) as offload:
        answers: list[Future[Plan]] = [offload.submit(plan_path, *one) for one in arguments]
        until(lambda: used or json.loads(read(f"{server.http}/health", token))["running"], "plans run")
        began = time.monotonic()
        docker("stop", "--time", str(grace_s), NAME)
        took_s = time.monotonic() - began
        costs = [answer.result(ANSWER_S).cost for answer in answers]
    state = json.loads(docker("inspect", "--format", "{{json .State}}", NAME))
    print(f"{WAITING} plans were asked for; stopped after {took_s:.1f} s of {grace_s} s")
    print(f"the server answered {used.count('cloud')}, and the robot the rest")
    assert (state["ExitCode"], state["OOMKilled"]) == (0, False)
    logs = subprocess.run(["docker", "logs", NAME], capture_output=True, text=True, timeout=60)
    assert "every accepted request was answered" in logs.stdout + logs.stderr
    assert "cloud" in used
    assert costs == [plan_path(*one).cost for one in arguments]


def connect(server: Running, robot: str, *observers: Callable[[Record], None]) -> Offloader:
    """A robot with its keys that sends every task to the server."""
    keys = server.folder / robot
    offload = Offloader.connect(
        server.endpoint, policy="cloud", timeout_s=ANSWER_S, keys=keys, observers=observers
    )
    assert offload.wait_for_sites(plan_path, NOTICED_S) == {}
    return offload


def plans(count: int) -> list[tuple[Any, ...]]:
    """Arguments of `plan_path` on a real map."""
    grid = resampled(read_map(ROOT / "maps" / "willow-full-0.05.yaml"), 0.025)
    pairs = free_pairs(grid, count, seed=1, radius_m=RADIUS_M)
    ends = (grid.metres(pair) for pair in pairs)
    return [(grid, None, Pose(*map(float, start)), Point(*map(float, goal))) for start, goal in ends]


def make_robot(folder: Path, name: str) -> None:
    """The keys of a robot, with the public key of the server."""
    make_keys(folder / name, "robot")
    (folder / name / "server.key").write_bytes((folder / "server.key").read_bytes())


def probe_until_started(pod: Pod, http: str) -> None:
    """Ask as the startup probe does, until it holds; fail when the kubelet would restart the container."""
    probe = pod.server["startupProbe"]
    for _ in range(probe["failureThreshold"]):
        time.sleep(probe["periodSeconds"])
        if status(http + probe["httpGet"]["path"]) == 200:
            return
    pytest.fail(f"not ready within the startup probe: {docker('logs', NAME)}")


def status(url: str) -> int:
    """The status of the answer; 0 without one."""
    try:
        with urllib.request.urlopen(url, timeout=2) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code
    except OSError:
        return 0


def read(url: str, token: str) -> str:
    request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"})
    with urllib.request.urlopen(request, timeout=5) as answer:
        return str(answer.read().decode())


def project(volume: str, pod: Pod, files: Mapping[str, Path], mode: str) -> None:
    """Put files into a volume as the kubelet does: in a new folder, behind a link that is replaced."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as archive:
        for name, path in files.items():
            archive.add(path, name)
    links = "".join(f"ln -sfn ..data/{name} /volume/{name}; " for name in files)
    as_root(
        volume,
        f"new=$(mktemp -d /volume/..XXXXXX) && chmod 755 $new && tar -x -C $new && chmod {mode} $new/* "
        f"&& chown -R 0:{pod.group} $new && ln -s $(basename $new) /volume/..data_tmp "
        f"&& mv -T /volume/..data_tmp /volume/..data; {links}",
        data.getvalue(),
    )


def as_root(volume: str, script: str, data: bytes = b"") -> None:
    """Run a shell script with the volume at /volume."""
    options = ("--rm", "--interactive", "--network", "none", "--user", "0", "--volume", f"{volume}:/volume")
    done = subprocess.run(
        ["docker", "run", *options, "--entrypoint", "sh", "offboard-cloud", "-euc", script],
        input=data,
        capture_output=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
