"""Robots that find a server by its name; a script for `run_alone`.

`python -m tests.names kinds` prints, for names with IPv4 and IPv6 addresses, how long a robot takes to use
the server, and the exit code of `robot-client check`. `python -m tests.names silent ENDPOINT` prints for a
name, while the DNS server says nothing, how long `connect` takes, and `close`; what `wait_for_sites` says
between them; and how many threads and files are left after that.
"""

import json
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from offboard.robot_client.offloader import Offloader
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD
from tests.cables import START_S, server, shell, wait_for_cloud
from tests.leftovers import left, left_for_good
from tests.probes import echo

SIX, FOUR = "fd77::2", "10.77.0.2"
LOOKUP_S = 30.0  # glibc asks for up to 10 s for each kind of address
HOSTS = f"{SIX} six\n{FOUR} four\n{FOUR} both\n{SIX} both\n"
ENDPOINTS = (
    "tcp://[fd77::2]:5556",
    "tcp://six:5556",
    "tcp://both:5556",
    "tcp://four:5554",
    "tcp://both:5554",
)


def main(what: str, *endpoint: str) -> None:
    folder = Path(tempfile.mkdtemp())
    (folder / "hosts").write_text(HOSTS)
    (folder / "resolv.conf").write_text(f"nameserver {FOUR}\n")
    shell(f"""
        mount --bind {folder}/hosts /etc/hosts
        mount --bind {folder}/resolv.conf /etc/resolv.conf
        ip link set lo up
        ip address add {FOUR}/32 dev lo
        ip -6 address add {SIX}/128 dev lo nodad
    """)
    print(json.dumps({"kinds": kinds, "silent": silent}[what](*endpoint)))


def kinds() -> dict[str, tuple[float, int]]:
    servers = f"tcp://{FOUR}:5554", f"tcp://[{SIX}]:5556"
    with server(servers[0]), server(servers[1]):
        for endpoint in servers:
            reach(endpoint)  # the server may still be starting
        return {endpoint: reach(endpoint) for endpoint in ENDPOINTS}


def silent(endpoint: str) -> tuple[float, float, dict[str, str], tuple[int, int]]:
    Offloader.connect("tcp://127.0.0.1:9").close()  # opens what stays open
    before = left_for_good()
    with socket.socket(type=socket.SOCK_DGRAM) as dns:
        dns.bind((FOUR, 53))
        began_s = time.monotonic()
        offload = Offloader.connect(sites={CLOUD: endpoint}, policy=CLOUD, settings=Settings(insecure=True))
        connect_s = time.monotonic() - began_s
        dns.recv(512)  # the lookup has begun
        absent = offload.wait_for_sites(echo, 0.1)
        began_s = time.monotonic()
        offload.close()
        took_s = time.monotonic() - began_s
    end_s = time.monotonic() + LOOKUP_S
    while left() != before and time.monotonic() < end_s:
        time.sleep(0.1)
    threads, files = left()
    return connect_s, took_s, absent, (threads - before[0], files - before[1])


def reach(endpoint: str) -> tuple[float, int]:
    """The seconds until the server is used, and the exit code of the check."""
    with Offloader.connect(endpoint, policy=CLOUD, timeout_s=5.0) as offload:
        took_s = wait_for_cloud(offload, START_S)
    check = [sys.executable, "-m", "offboard.robot_client", "check", endpoint, "--tasks", "tests.probes"]
    done = subprocess.run(check, stdout=sys.stderr)
    return took_s, done.returncode


if __name__ == "__main__":
    main(*sys.argv[1:])
