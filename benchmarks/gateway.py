"""What `robot-client gateway` adds to an observation on loopback: asked directly and through it, in turn.

    python -m benchmarks.gateway [--bytes 150000]

The server echoes at once, and runs in a process of its own, as the gateway does.
"""

import argparse
import socket
import statistics
import subprocess
import sys
import time

import numpy as np
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import ServerConnection, serve

from benchmarks.measure import Requirement, Table
from offboard.robot_client.policy_servers.openpi import pack

ROUNDS = 600
WARM = 50
ADDED_MS = 1.0
WAIT_S = 20.0


def echo(port: int) -> None:
    """A policy server whose action is small."""

    def talk(connection: ServerConnection) -> None:
        connection.send(pack({}))
        answer = pack({"actions": np.zeros((50, 7), np.float32)})
        for _ in connection:
            connection.send(answer)

    serve(talk, "127.0.0.1", port, compression=None, max_size=None).serve_forever()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        return int(unused.getsockname()[1])


def opened(port: int) -> ClientConnection:
    """A connection that has the metadata."""
    until_s = time.monotonic() + WAIT_S
    while True:
        try:
            client = connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None)
        except OSError:
            assert time.monotonic() < until_s
            time.sleep(0.1)
        else:
            client.recv(WAIT_S)
            return client


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gateway", description=__doc__.splitlines()[0])
    parser.add_argument("--bytes", type=int, default=150_000, help="of an image (default: %(default)s)")
    parser.add_argument("--serve", type=int, default=0, help=argparse.SUPPRESS)
    flags = parser.parse_args()
    if flags.serve:
        echo(flags.serve)
        return
    server, door = free_port(), free_port()
    here = [sys.executable, "-m"]
    parts = [
        subprocess.Popen([*here, "benchmarks.gateway", f"--serve={server}"]),
        subprocess.Popen(
            [*here, "offboard.robot_client", "gateway", f"--listen=ws://127.0.0.1:{door}",
             f"--site=gpu=ws://127.0.0.1:{server}"]
        ),
    ]  # fmt: skip
    try:
        clients = {"direct": opened(server), "gateway": opened(door)}
        data = pack({"image": np.zeros(flags.bytes, np.uint8), "state": np.zeros(7, np.float32)})
        seconds: dict[str, list[float]] = {name: [] for name in clients}
        for number in range(ROUNDS + WARM):
            for name in clients if number % 2 else reversed(clients):
                began_s = time.perf_counter()
                clients[name].send(data)
                clients[name].recv(WAIT_S)
                if number >= WARM:
                    seconds[name].append(time.perf_counter() - began_s)
    finally:
        for part in parts:
            part.kill()
            part.wait()
    ms = {name: [1e3 * float(np.quantile(of, at)) for at in (0.5, 0.9, 0.99)] for name, of in seconds.items()}
    rows = [[name, *(f"{one:.2f}" for one in of)] for name, of in ms.items()]
    added = 1e3 * statistics.median(
        through - direct for through, direct in zip(seconds["gateway"], seconds["direct"], strict=True)
    )
    print(Table(
        f"An observation of {len(data):,} bytes, ms", ["way", "P50", "P90", "P99"], rows,
        [Requirement("added by the gateway, P50 of the differences", added, ADDED_MS, "ms")],
    ))  # fmt: skip


if __name__ == "__main__":
    main()
