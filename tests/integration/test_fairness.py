"""A robot that floods the server does not keep it from serving the others."""

import select
import subprocess
import sys
import time
from collections import Counter

import pytest
import zmq

from benchmarks.servers import cloud_server
from offboard.common.wire import messages as wire
from tests.probes import nap

pytestmark = pytest.mark.integration

ROBOTS = 6
NAP_S = 0.01
SECONDS = 3.0
TIMES = 50  # the flood asks for this many times its share
FLOOD_IN_FLIGHT = 200


def ask(socket: "zmq.Socket[bytes]", id: int) -> None:
    body = wire.encode([NAP_S]).frames
    socket.send_multipart(wire.pack(wire.Request(id, nap.__name__, 30.0, 1, (), body)))


def answers(endpoint: str) -> Counter[int]:
    """For each of ROBOTS, the answers that it gets in SECONDS if it asks for one at a time."""
    with zmq.Context() as context:
        sockets = [context.socket(zmq.DEALER) for _ in range(ROBOTS)]
        poller, found = zmq.Poller(), Counter[int]()
        for socket in sockets:
            socket.linger = 0
            socket.connect(endpoint)
            poller.register(socket, zmq.POLLIN)
            ask(socket, 0)
        until = time.monotonic() + SECONDS
        while time.monotonic() < until:
            for ready, _ in poller.poll(100):
                reply = wire.unpack(ready.recv_multipart())
                assert isinstance(reply, wire.Reply)
                assert reply.status == "ok", reply
                found[sockets.index(ready)] += 1
                ask(ready, found.total())
        for socket in sockets:
            socket.close()
    return found


def flood(endpoint: str, rate: float) -> None:
    """Print a line when the queue is full, and at the end the `ok` and `busy` since a line of stdin."""
    statuses, counted, full = Counter[str](), Counter[str](), False
    sent, began = 0, time.monotonic()
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.linger = 0
        socket.connect(endpoint)
        while True:
            if select.select([sys.stdin], [], [], 0.005)[0]:
                if not sys.stdin.readline():
                    break
                counted = statuses.copy()
            while socket.poll(0):
                reply = wire.unpack(socket.recv_multipart())
                assert isinstance(reply, wire.Reply)
                statuses[reply.status] += 1
            due = int((time.monotonic() - began) * rate)
            while sent < due and sent - statuses.total() < FLOOD_IN_FLIGHT:
                ask(socket, sent)
                sent += 1
            if statuses["busy"] and not full:
                full = True
                print("full", flush=True)
    print(statuses["ok"] - counted["ok"], statuses["busy"] - counted["busy"])


def test_a_flood_takes_its_share_and_no_more() -> None:
    """At 50 times its share it gets `busy` and no more answers than others, who are served in turn."""
    with cloud_server("tests.probes", CLOUD_WORKERS="1") as server:
        rate = TIMES / NAP_S / (ROBOTS + 1)  # one worker serves 1 / NAP_S at most
        command = f"from tests.integration.test_fairness import flood; flood({server.endpoint!r}, {rate})"
        flooding = subprocess.Popen(
            [sys.executable, "-c", command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert flooding.stdin is not None
        assert flooding.stdout is not None
        assert flooding.stdout.readline() == "full\n"
        flooding.stdin.write("\n")
        flooding.stdin.flush()
        during = answers(server.endpoint)
        ok, busy = map(int, flooding.communicate("")[0].split())
    print(during, ok, busy)
    assert busy > ok > 0
    assert ok <= 1.2 * max(during.values()) + 1
    assert min(during.values()) >= 0.75 * max(during.values()) - 1
