"""A server, or somebody in its place, that sends a robot what is no message."""

import contextlib
import logging
import subprocess
import sys
import time
from collections.abc import Iterator

import msgpack
import pytest
import zmq

from offboard import Offloader
from offboard.common.logs import PAUSE_S
from offboard.common.wire import messages as wire
from offboard.common.wire.messages import Hello, Ping, Pong
from offboard.robot_client.cloud.cloud_socket import RECONNECT_MS
from offboard.robot_client.cloud.connection import LOG_LINES_MAX
from tests.integration.test_heartbeats import Peer, met
from tests.probes import echo

pytestmark = pytest.mark.integration

HEARTBEAT_S = 0.1
ROUNDS = 300
FLOOD_S = 3.0
TIMEOUT_S = 0.3  # of the server
SLACK_S = 2.0  # for a thread that gets no CPU
FOREIGN = msgpack.packb([wire.VERSION + 1, "hello", {}])


def say_junk(peer: Peer) -> int:
    """Send bytes of the right version that are no message; return how many."""
    (head,) = wire.pack(Pong(0))
    whole = bytes(head)
    junk = [[whole[:-1]], [whole, b"more"], [whole[:1]], [whole[:1] + b"\xc1" * 8]]
    for frames in junk:
        peer._socket.send_multipart([peer._client, *frames])
    return len(junk)


def test_junk_gives_one_line_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """Within PAUSE_S at most one bad message is logged; the robot still sends heartbeats."""
    with caplog.at_level(logging.WARNING), met(HEARTBEAT_S) as (runner, peer):
        sent = sum(say_junk(peer) for _ in range(ROUNDS))
        for _ in range(3):
            ping = peer.hear()
            assert isinstance(ping, Ping)
            peer.say(Pong(ping.id))
        assert runner.condition().round_trip_s is not None
    dropped = [one.getMessage() for one in caplog.records if "message dropped" in one.getMessage()]
    assert len(dropped) == 1, f"{sent} sent"
    assert f"(others within {PAUSE_S:g} s are not logged)" in dropped[0]


@pytest.fixture
def flooding() -> Iterator[str]:
    """The endpoint of a server that floods its robot with `hello` of two wire versions."""
    command = [sys.executable, "-m", "tests.flooding_server"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield f"tcp://127.0.0.1:{int(process.stdout.readline())}"
        process.kill()


def test_a_flood_of_two_wire_versions_delays_no_task(flooding: str, caplog: pytest.LogCaptureFixture) -> None:
    """Each call is answered within the timeout, and the log gets its first lines only."""
    longest_s, end_s = 0.0, time.monotonic() + FLOOD_S
    with caplog.at_level(logging.INFO), Offloader.connect(flooding, timeout_s=TIMEOUT_S) as offload:
        while (start_s := time.monotonic()) < end_s:
            assert offload(echo, 1) == 1
            longest_s = max(longest_s, time.monotonic() - start_s)
    lines = about_connection(caplog)
    assert len(lines) == LOG_LINES_MAX, lines
    assert lines[-1].endswith(f"(others within {PAUSE_S:g} s are not logged)")
    assert longest_s <= TIMEOUT_S + SLACK_S


def test_a_server_that_hangs_up_after_each_hello_fills_no_log(caplog: pytest.LogCaptureFixture) -> None:
    """The robot connects again after RECONNECT_MS or later, and the log gets its first lines only."""
    with caplog.at_level(logging.INFO), contextlib.ExitStack() as stack:
        context = stack.enter_context(zmq.Context())
        endpoint = hang_up(context, "tcp://127.0.0.1:*", wait_s=0.0)
        stack.enter_context(Offloader.connect(endpoint))
        start_s, met_again = time.monotonic(), 0
        while (now_s := time.monotonic()) < start_s + FLOOD_S:
            hang_up(context, endpoint, wait_s=SLACK_S)
            met_again += 1
    assert LOG_LINES_MAX < met_again <= 1 + (now_s + SLACK_S - start_s) / (RECONNECT_MS / 1e3)
    lines = about_connection(caplog)
    assert len(lines) == LOG_LINES_MAX, lines


def hang_up(context: "zmq.Context[zmq.Socket[bytes]]", endpoint: str, *, wait_s: float) -> str:
    """Answer one robot with `hello` of two wire versions, and end the connection; returns the endpoint."""
    with context.socket(zmq.ROUTER) as socket:
        socket.linger = 1000
        bind(socket, endpoint)
        if socket.poll(round(wait_s * 1e3)):
            robot, *_ = socket.recv_multipart()
            socket.send_multipart([robot, FOREIGN])
            socket.send_multipart([robot, *wire.pack(Hello({}, "0", 2**20))])
            assert socket.poll(round(wait_s * 1e3)), "no heartbeat: the robot has not read `hello`"
        return socket.last_endpoint.decode().rstrip("\0")


def bind(socket: "zmq.Socket[bytes]", endpoint: str) -> None:
    """libzmq frees the port in the background."""
    end_s = time.monotonic() + SLACK_S
    while True:
        try:
            socket.bind(endpoint)
        except zmq.ZMQError:
            if time.monotonic() > end_s:
                raise
            time.sleep(0.005)
        else:
            return


def about_connection(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [one.getMessage() for one in caplog.records if one.name.endswith("cloud.connection")]
