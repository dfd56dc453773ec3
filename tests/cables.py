"""A robot and a server in two network namespaces, with a cable between them; a script for `run_alone`.

`python -m tests.cables SECONDS first|later` prints how long a robot needs to use the server again after a
silent outage. `first`: the robot starts during the outage.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.runner import CLOUD
from tests.probes import echo

ROBOT, SERVER, PORT = "10.77.0.1", "10.77.0.2", 5555
ROBOT_CARD, SERVER_CARD = "02:00:00:00:00:01", "02:00:00:00:00:02"
START_S, BACK_S = 60.0, 40.0
TIMEOUT_S = 0.3
SETTINGS = ["--tasks", "tests.probes", "--insecure", "--http", "127.0.0.1:0"]
INSIDE = ["unshare", "--net", "sh", "-c", 'ip link set lo up; exec "$@"', "sh"]
LINEAR = Path("/proc/sys/net/ipv4/tcp_syn_linear_timeouts")  # new kernels repeat a SYN four times more


def shell(command: str) -> None:
    subprocess.run(["sh", "-ec", command], check=True)


@contextmanager
def server(listen: str, *more: str) -> Iterator[int]:
    """A server in a network namespace of its own if `more` says so; gives the number of its process."""
    command = [*more, sys.executable, "-m", "offboard.cloud_server", "--listen", listen, *SETTINGS]
    process = subprocess.Popen(command, stdout=sys.stderr)
    try:
        yield process.pid
    finally:
        process.kill()
        process.wait()


@contextmanager
def cable() -> Iterator[Callable[[str], None]]:
    """Starts a server; the function does `add` or `del` to a route that swallows all packets to the robot."""
    with server(f"tcp://0.0.0.0:{PORT}", *INSIDE) as pid:
        while Path(f"/proc/{pid}/ns/net").readlink() == Path("/proc/self/ns/net").readlink():
            time.sleep(0.01)
        inside = f"nsenter -t {pid} -n"
        # A computer that does not answer ARP is reported as unreachable, which is not silence.
        shell(f"""
            ip link add name robot address {ROBOT_CARD} type veth peer name server address {SERVER_CARD}
            ip link set server netns {pid}
            ip address add {ROBOT}/24 dev robot
            ip link set robot up
            ip neighbour add {SERVER} lladdr {SERVER_CARD} dev robot nud permanent
            {inside} ip address add {SERVER}/24 dev server
            {inside} ip link set server up
            {inside} ip neighbour add {ROBOT} lladdr {ROBOT_CARD} dev server nud permanent
        """)
        yield lambda do: shell(f"{inside} ip route {do} blackhole {ROBOT}/32")


def used(offload: Offloader) -> str | None:
    assert offload(echo, 7) == 7
    assert offload.last is not None
    return offload.last.used


def wait_for_cloud(offload: Offloader, timeout_s: float) -> float:
    """The seconds until a task is answered by the cloud."""
    began_s = time.monotonic()
    while used(offload) != CLOUD:
        assert time.monotonic() - began_s < timeout_s, "the server is not used"
        time.sleep(0.02)
    return time.monotonic() - began_s


def main(seconds: float, when: str) -> None:
    if LINEAR.exists():
        LINEAR.write_text("0")
    with cable() as route:
        with Offloader.connect(f"tcp://{SERVER}:{PORT}", policy=CLOUD, timeout_s=TIMEOUT_S) as offload:
            wait_for_cloud(offload, START_S)
            if when == "later":
                route("add")
                play(offload, route, seconds)
        if when == "first":
            route("add")
            with Offloader.connect(f"tcp://{SERVER}:{PORT}", policy=CLOUD, timeout_s=TIMEOUT_S) as offload:
                play(offload, route, seconds)


def play(offload: Offloader, route: Callable[[str], None], seconds: float) -> None:
    """Call during the outage, end it, and print how long the server is not used after that."""
    waits, end_s = [], time.monotonic() + seconds
    while time.monotonic() < end_s:
        began_s = time.monotonic()
        assert used(offload) != CLOUD
        waits.append(time.monotonic() - began_s)
        time.sleep(0.05)
    route("del")
    print(json.dumps({"back_s": wait_for_cloud(offload, BACK_S), "worst_s": max(waits)}))


if __name__ == "__main__":
    main(float(sys.argv[1]), sys.argv[2])
