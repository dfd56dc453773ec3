"""The relay as a process: what the link does to real sockets, and how it is changed while it runs."""

import contextlib
import json
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from typing import Any

import pytest

from offboard.loadgen.relay.control_api import BODY_BYTES_MAX
from offboard.loadgen.relay.link.link import SAMPLES_MAX
from offboard.loadgen.relay.link_schedule import EVENTS_MAX
from offboard.loadgen.relay.wan import WanConfig
from tests.flags import completed
from tests.relays import QUIET_S, WAIT_S, WAN, echo, quietest, receive, round_trip_s, silent, wait_until

pytestmark = pytest.mark.integration


def test_delay_is_added_to_each_direction(cloud: Any, wan: Any) -> None:
    """With 15 ms in each direction the median round trip takes 30 to 31.5 ms."""
    with wan(cloud(echo), "--delay-ms", "15").connect() as client:
        median_ms = 1e3 * quietest(lambda: round_trip_s(client))
    print(f"round trip {median_ms:.3f} ms")
    assert 30.0 <= median_ms <= 31.5


def test_a_reply_of_several_chunks_is_not_delayed(cloud: Any, wan: Any) -> None:
    """Over the default link a reply of 20 kB takes 30.4 to 31.9 ms at the median.

    Its last bytes do not wait for the acknowledgement of the first ones, which would take 40 ms.
    """
    size = 20_000

    def reply(connection: socket.socket) -> None:
        while connection.recv(4):
            connection.sendall(bytes(size))

    with wan(cloud(reply)).connect() as client:

        def ask_s() -> float:
            start = time.perf_counter()
            client.sendall(b"give")
            assert len(receive(client, size)) == size
            return time.perf_counter() - start

        median_ms = 1e3 * quietest(ask_s)
    print(f"reply after {median_ms:.3f} ms")
    assert 30.4 <= median_ms <= 31.9


def test_the_relay_itself_adds_little_time(cloud: Any, wan: Any) -> None:
    """Without conditions the relay adds less than 0.25 ms to the median round trip.

    Direct and relayed connections are measured in turns, and the lowest median of each counts.
    """
    port = cloud(echo)
    relay = wan(port, "--delay-ms", "0", "--bandwidth-mbps", "0")
    with relay.connect() as relayed, socket.create_connection(("127.0.0.1", port)) as direct:
        rounds = [
            (quietest(lambda: round_trip_s(direct)), quietest(lambda: round_trip_s(relayed)))
            for _ in range(5)
        ]
    direct_ms, relayed_ms = (1e3 * min(medians_s) for medians_s in zip(*rounds, strict=True))
    print(f"direct {direct_ms:.3f} ms, relayed {relayed_ms:.3f} ms, added {relayed_ms - direct_ms:.3f} ms")
    assert 0 < relayed_ms - direct_ms < 0.25


def test_the_bandwidth_is_limited(cloud: Any, wan: Any) -> None:
    """At 20 Mbps 5 MB take 2.0 s, plus or minus 5 %."""
    size = 5_000_000
    taken_s: list[float] = []

    def sink(connection: socket.socket) -> None:
        assert len(receive(connection, size)) == size
        connection.sendall(b"k")

    with wan(cloud(sink), "--delay-ms", "0", "--bandwidth-mbps", "20").connect() as client:
        start = time.perf_counter()
        client.sendall(bytes(size))
        assert client.recv(1) == b"k"
        taken_s.append(time.perf_counter() - start)
    print(f"taken {taken_s[0]:.3f} s")
    assert taken_s[0] == pytest.approx(2.0, rel=0.05)


def test_large_streams_arrive_complete_through_small_buffers(cloud: Any, wan: Any) -> None:
    """With jitter and buffers of 64 KiB, 20 MB come back byte for byte and in order."""
    relay = wan(
        cloud(echo), "--delay-ms", "1", "--jitter-ms", "1", "--buffer-bytes", "65536", "--bandwidth-mbps", "0"
    )
    data = b"".join(n.to_bytes(4, "big") for n in range(500_000))
    with relay.connect() as client:
        sender = threading.Thread(target=client.sendall, args=(data,))
        sender.start()
        assert receive(client, len(data)) == data
        sender.join()


def test_a_slow_reader_gets_every_byte(cloud: Any, wan: Any) -> None:
    """A cloud that reads slowly gets 20 MB byte for byte, which is more than the sockets can hold."""
    got = bytearray()

    def read_slowly(connection: socket.socket) -> None:
        while data := connection.recv(200_000):
            got.extend(data)
            time.sleep(0.001)

    data = random.Random(0).randbytes(20_000_000)
    relay = wan(cloud(read_slowly), "--delay-ms", "0", "--bandwidth-mbps", "0")
    with relay.connect() as client:
        client.sendall(data)
    wait_until(lambda: len(got) == len(data))
    assert got == data


def test_a_reader_that_stops_makes_the_sender_wait(cloud: Any, wan: Any) -> None:
    """If the cloud does not read, the sender must wait as soon as the buffers are full."""
    go_on = threading.Event()
    relay = wan(cloud(lambda _: go_on.wait(WAIT_S)), "--delay-ms", "0", "--buffer-bytes", "65536")
    with relay.connect() as client:
        client.settimeout(QUIET_S)
        sent = 0
        with contextlib.suppress(TimeoutError):
            while sent < 100_000_000:
                sent += client.send(bytes(65536))
        go_on.set()
    assert 65536 <= sent < 50_000_000  # the kernel buffers of four sockets, and those of the relay


def test_bytes_before_a_close_are_delivered(cloud: Any, wan: Any) -> None:
    """If the cloud answers and closes at once, the answer arrives after the delay, then the end."""
    relay = wan(cloud(lambda connection: connection.sendall(b"bye")), "--delay-ms", "40")
    with relay.connect() as client:
        start = time.perf_counter()
        assert receive(client, 3) == b"bye"
        assert client.recv(1) == b""
        assert time.perf_counter() - start >= 0.04
    wait_until(lambda: relay.ask("GET", "/link")[1]["connections"] == 0)


def test_a_client_that_closes_ends_the_cloud_side(cloud: Any, wan: Any) -> None:
    """The cloud gets all bytes of a client that has closed, then the end."""
    got: list[bytes] = []
    relay = wan(cloud(lambda connection: got.append(receive(connection, 1 << 30))), "--delay-ms", "20")
    with relay.connect() as client:
        client.sendall(b"x" * 100_000)
    wait_until(lambda: got)
    assert got == [b"x" * 100_000]
    wait_until(lambda: relay.ask("GET", "/link")[1]["connections"] == 0)


def test_a_refusing_cloud_closes_the_client_at_once(wan: Any) -> None:
    """If nobody listens in the cloud, the connection of the client ends, so that it can connect again."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        nobody = taken.getsockname()[1]
    with wan(nobody).connect() as client, contextlib.suppress(ConnectionResetError):
        assert client.recv(1) == b""


def test_a_connection_beyond_the_limit_is_closed(cloud: Any, wan: Any) -> None:
    """The new connection is closed, and the earlier ones continue."""
    relay = wan(cloud(echo), "--connections-max", "1", "--delay-ms", "0")
    with relay.connect() as first, relay.connect() as second:
        assert second.recv(1) == b""
        round_trip_s(first)
        assert relay.ask("GET", "/link")[1]["refused"] == 1


def test_an_outage_is_silence(cloud: Any, wan: Any) -> None:
    """In an outage open and new connections receive nothing; their bytes are delivered after it."""
    relay = wan(cloud(echo), "--delay-ms", "5")
    with relay.connect() as old:
        round_trip_s(old)
        assert relay.change(outage=True)["outage"] is True
        with relay.connect() as new:
            old.sendall(b"old!")
            new.sendall(b"new!")
            assert silent(old)
            assert silent(new)
            assert relay.change(outage=False)["outage"] is False
            assert receive(old, 4) == b"old!"
            assert receive(new, 4) == b"new!"


def test_an_outage_can_be_in_one_direction(cloud: Any, wan: Any) -> None:
    """With an outage from cloud to robot, the cloud still receives, and the robot receives nothing."""
    got: list[bytes] = []

    def answer(connection: socket.socket) -> None:
        for _ in range(2):
            got.append(receive(connection, 4))
            connection.sendall(got[-1])

    relay = wan(cloud(answer), "--delay-ms", "0")
    with relay.connect() as client:
        round_trip_s(client)
        relay.change(down={"outage": True})
        client.sendall(b"more")
        wait_until(lambda: got == [b"ping", b"more"])
        assert silent(client)
        relay.change(outage=False)
        assert receive(client, 4) == b"more"


def test_a_new_delay_applies_at_once(cloud: Any, wan: Any) -> None:
    """The next round trip of an open connection has the new delay."""
    relay = wan(cloud(echo), "--delay-ms", "0")
    with relay.connect() as client:
        assert quietest(lambda: round_trip_s(client), 4) == pytest.approx(0, abs=0.01)
        link = relay.change(up={"delay_ms": 30})
        assert (link["up"]["delay_ms"], link["down"]["delay_ms"]) == (30, 0)
        assert quietest(lambda: round_trip_s(client), 4) == pytest.approx(0.0305, abs=0.003)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"delay": 3}, "delay: unknown condition; known: delay_ms"),
        ({"up": {"up": {}}}, "up.up: unknown condition; known: delay_ms"),
        ({"down": {"delay_ms": -3}}, "down.delay_ms: -3.0 is not a number from 0 to 60000"),
        ({"distribution": "gamma"}, "up.distribution: 'gamma' is not one of constant, uniform"),
        ({"outage": "yes"}, "outage: 'yes': Input should be a valid boolean"),
        ('{"delay_ms": NaN}', "up.delay_ms: nan is not a number"),
        ("{", "body: not JSON"),
    ],
)
def test_a_wrong_change_is_refused(wan: Any, body: Any, message: str) -> None:
    """An unknown condition or a wrong value gets a 422 that names it, and changes nothing."""
    relay = wan(1)
    before = relay.ask("GET", "/link")
    status, reply = relay.ask("PUT", "/link", body)
    assert status == 422
    assert reply["detail"].startswith(message)
    assert relay.ask("GET", "/link") == before


@pytest.mark.parametrize(("method", "path"), [("PUT", "/link"), ("POST", "/schedule")])
def test_a_long_request_body_is_refused(wan: Any, method: str, path: str) -> None:
    """A body that is one byte too long gets a 413 that names the bound; the longest allowed body is read."""
    relay = wan(1)
    before = relay.ask("GET", path)
    assert relay.ask(method, path, " " * (BODY_BYTES_MAX - 2) + "{}")[0] == 200
    status, reply = relay.ask(method, path, " " * (BODY_BYTES_MAX - 1) + "{}")
    assert (status, reply) == (413, {"detail": "body: longer than 4194304 bytes"})
    assert relay.ask("GET", path) == before


def test_the_longest_samples_and_schedule_are_accepted(wan: Any) -> None:
    """The API takes the largest allowed number of delays and of events, and refuses one more event."""
    relay = wan(1)
    samples = [1 + n / 3 for n in range(SAMPLES_MAX)]
    link = relay.change(up={"samples": samples}, down={"samples": samples})
    assert (link["up"]["samples"], link["down"]["samples"]) == (SAMPLES_MAX, SAMPLES_MAX)
    events = [{"at_s": 1000 + n / 3, "up": {"delay_ms": n / 3}} for n in range(EVENTS_MAX)]
    assert relay.ask("POST", "/schedule", {"event": events})[0] == 200
    status, reply = relay.ask("POST", "/schedule", {"event": [*events, {"at_s": 1}]})
    assert status == 422
    assert reply["detail"] == "schedule: 10001 events; at most 10000 are allowed"


def test_the_api_describes_itself(wan: Any) -> None:
    """/health answers, and the OpenAPI description has /link and its conditions."""
    relay = wan(1)
    assert relay.ask("GET", "/health") == (200, {"status": "ok", "insecure": False})
    schema = relay.ask("GET", "/openapi.json")[1]
    assert set(schema["paths"]["/link"]) == {"get", "put"}
    assert "bandwidth_mbps" in json.dumps(schema["components"])


@pytest.mark.parametrize("stop", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_the_relay(cloud: Any, wan: Any, stop: signal.Signals) -> None:
    """SIGTERM and Ctrl-C end the relay with exit code 0, also while a connection is open."""
    relay = wan(cloud(echo))
    with relay.connect() as client:
        round_trip_s(client)
        relay.process.send_signal(stop)
        assert relay.process.wait(WAIT_S) == 0


@pytest.mark.parametrize("flag", ["--listen", "--http"])
def test_a_port_in_use_is_a_mistake_of_the_user(flag: str) -> None:
    """A port that is in use gives exit code 2 and one line that names the flag and the port."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"127.0.0.1:{taken.getsockname()[1]}"
        command = [sys.executable, "-c", WAN]
        command += completed([flag, endpoint], listen="127.0.0.1:0", http="127.0.0.1:0")
        done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S)
    assert done.returncode == 2
    assert done.stderr == f"wan: {flag}: cannot listen on {endpoint}: Address already in use\n"


def test_an_unknown_host_is_a_mistake_of_the_user() -> None:
    """An unknown host name gives exit code 2 and one line with the flag and the reason."""
    command = [sys.executable, "-c", WAN, "--listen", "no-such-host.invalid:1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S)
    assert done.returncode == 2
    assert done.stderr.startswith("wan: --listen: cannot listen on no-such-host.invalid:1: ")
    assert done.stderr.count("\n") == 1


def test_an_idle_relay_uses_little_cpu(cloud: Any, wan: Any) -> None:
    """With one idle connection the relay uses at most 3 % of a CPU."""
    relay = wan(cloud(echo))
    with relay.connect() as client:
        round_trip_s(client)
        clock = (~relay.process.pid << 3) | 2
        before = time.clock_gettime(clock)
        time.sleep(1)
        used = time.clock_gettime(clock) - before
    print(f"idle {used:.4f} CPU")
    assert used == pytest.approx(0, abs=0.03)


def test_the_default_link_is_that_of_the_paper() -> None:
    """The default is 15 ms and 400 Mbps in each direction."""
    link = WanConfig().link
    assert link.up == link.down
    assert (link.up.delay_ms, link.up.jitter_ms, link.up.bandwidth_mbps) == (15, 0, 400)
