"""Hang, reset, truncation, loss, samples and schedules of the relay, on real sockets."""

import contextlib
import socket
import statistics
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from offboard.loadgen.relay.link.link import SEGMENT_BYTES
from tests.relays import (
    WAIT_S,
    WAN,
    echo,
    is_reset,
    quietest,
    read_record,
    receive,
    round_trip_s,
    silent,
    stop,
    wait_until,
)

pytestmark = pytest.mark.integration

BARE = ("--delay-ms", "0", "--bandwidth-mbps", "0")


def test_a_hanging_cloud_reads_everything_and_answers_nothing(cloud: Any, wan: Any) -> None:
    """In a hang, old and new connections take more bytes than any buffer, and receive nothing.

    After it, connections that lost bytes are reset, a connection that lost none continues, and new ones work.
    """
    heard: list[bytes] = []

    def talk(connection: socket.socket) -> None:
        while data := connection.recv(65536):
            heard.append(data)
            connection.sendall(data)

    relay = wan(cloud(talk), *BARE, "--buffer-bytes", "65536")
    with relay.connect() as old, relay.connect() as quiet:
        round_trip_s(old)
        round_trip_s(quiet)
        relay.change(hang=True)
        with relay.connect() as new:
            for client in (old, new):
                client.sendall(bytes(30_000_000))  # returns, because the relay reads and drops the bytes
                assert silent(client)
            assert heard == [b"ping", b"ping"]
            relay.change(hang=False)
            assert is_reset(old)
            assert is_reset(new)
        round_trip_s(quiet)
        with relay.connect() as after:
            round_trip_s(after)


def test_a_hang_can_be_in_one_direction(cloud: Any, wan: Any) -> None:
    """With a hang from cloud to robot, the cloud receives the request, and its answer is lost."""
    heard: list[bytes] = []

    def talk(connection: socket.socket) -> None:
        heard.append(receive(connection, 4))
        connection.sendall(b"answ")
        connection.recv(1)

    relay = wan(cloud(talk), *BARE, "--down-hang")
    with relay.connect() as client:
        client.sendall(b"ping")
        wait_until(lambda: heard == [b"ping"])
        assert silent(client)
        relay.change(hang=False)
        assert is_reset(client)


def test_connections_are_reset_after_a_time(cloud: Any, wan: Any) -> None:
    """With reset_after_ms both sides get ECONNRESET, at this time or up to 100 ms later."""
    ends: list[bool] = []

    def talk(connection: socket.socket) -> None:
        ends.append(is_reset(connection))

    relay = wan(cloud(talk), *BARE, "--up-reset-after-ms", "200")
    start = time.perf_counter()
    with relay.connect() as client:
        assert is_reset(client)
        taken_s = time.perf_counter() - start
    print(f"reset after {taken_s:.4f} s")
    assert 0.2 <= taken_s <= 0.3
    wait_until(lambda: ends == [True])


def test_the_time_of_a_reset_counts_from_the_change(cloud: Any, wan: Any) -> None:
    """The time of a reset starts when it is set; in an outage the reset comes after its end."""
    relay = wan(cloud(echo), *BARE)
    with relay.connect() as client:
        round_trip_s(client)
        relay.change(outage=True, reset_after_ms=1)
        assert silent(client)
        relay.change(outage=False)
        assert is_reset(client)


def test_a_reset_over_http(cloud: Any, wan: Any) -> None:
    """POST /reset resets every open connection; a new connection works."""
    relay = wan(cloud(echo), *BARE)
    with relay.connect() as first, relay.connect() as second:
        round_trip_s(first)
        round_trip_s(second)
        assert relay.ask("POST", "/reset") == (200, {"reset": 2})
        assert is_reset(first)
        assert is_reset(second)
    with relay.connect() as third:
        round_trip_s(third)


@pytest.mark.parametrize("size", [1, SEGMENT_BYTES, 100_001])
def test_a_request_is_truncated_at_the_exact_byte(cloud: Any, wan: Any, size: int) -> None:
    """The cloud gets exactly `size` bytes, then the end, and the connection of the client is closed."""
    got: list[bytes] = []
    relay = wan(
        cloud(lambda connection: got.append(receive(connection, 1 << 30))),
        *("--delay-ms", "5", "--up-truncate-bytes", str(size)),
    )
    data = bytes(range(256)) * 1000
    with relay.connect() as client:
        with contextlib.suppress(ConnectionError):
            client.sendall(data)
            assert client.recv(1) == b""
        wait_until(lambda: got)
    assert got == [data[:size]]
    wait_until(lambda: relay.ask("GET", "/link")[1]["connections"] == 0)


def test_an_answer_is_truncated_at_the_exact_byte(cloud: Any, wan: Any) -> None:
    """The client gets exactly 7 bytes of each connection."""
    relay = wan(cloud(echo), *BARE, "--down-truncate-bytes", "7")
    for _ in range(2):
        with relay.connect() as client:
            client.sendall(b"ping")
            assert receive(client, 4) == b"ping"
            client.sendall(b"pong")
            assert receive(client, 9) == b"pon"


def test_a_slow_close_delays_the_end(cloud: Any, wan: Any) -> None:
    """With a slow_close_ms of 300, the bytes come at once, and the end 300 to 400 ms later."""
    relay = wan(cloud(lambda connection: connection.sendall(b"bye")), *BARE, "--slow-close-ms", "300")
    with relay.connect() as client:
        assert receive(client, 3) == b"bye"
        start = time.perf_counter()
        assert client.recv(1) == b""
        taken_s = time.perf_counter() - start
    print(f"end after {taken_s:.4f} s")
    assert 0.29 <= taken_s <= 0.4  # the end was sent a moment before the bytes were received here


def test_a_lost_segment_stalls_the_connection(cloud: Any, wan: Any) -> None:
    """If all segments are lost, the first answer comes after six retransmissions in each direction."""
    relay = wan(cloud(echo), *BARE, "--loss", "1", "--stall-ms", "2")
    with relay.connect() as client:
        first_ms = 1e3 * round_trip_s(client)
        later_ms = 1e3 * statistics.median(round_trip_s(client) for _ in range(9))
    print(f"first {first_ms:.1f} ms, later {later_ms:.1f} ms")
    assert 2 * 126 <= first_ms <= 2 * 126 + 100
    assert later_ms <= 20  # the same segment is lost once


def test_loss_does_not_change_the_bytes(cloud: Any, wan: Any) -> None:
    """With bursts of loss, correlated jitter and small buffers, 3 MB come back byte for byte."""
    flags = ("--loss", "0.02", "--loss-burst", "5", "--stall-ms", "1", "--jitter-ms", "0.2")
    relay = wan(cloud(echo), *BARE, *flags, "--correlation", "0.5", "--buffer-bytes", "65536")
    data = b"".join(n.to_bytes(4, "big") for n in range(750_000))
    with relay.connect() as client:
        sender = threading.Thread(target=client.sendall, args=(data,))
        sender.start()
        assert receive(client, len(data)) == data
        sender.join()


def test_segments_do_not_wait_for_an_acknowledgement(cloud: Any, wan: Any) -> None:
    """With a delay of 5 ms +- 4 ms in one direction, messages of two segments take about 7 ms at the median.

    With Nagle's algorithm the second segment would wait 40 ms for the acknowledgement of the first one.
    """
    shape = ("--down-delay-ms", "5", "--down-jitter-ms", "4", "--distribution", "uniform")
    message = bytes(2000)
    with wan(cloud(echo), *BARE, *shape).connect() as client:

        def exchange_s() -> float:
            start = time.perf_counter()
            client.sendall(message)
            assert receive(client, len(message)) == message
            return time.perf_counter() - start

        median_ms = 1e3 * quietest(exchange_s)
    print(f"median {median_ms:.3f} ms")
    assert 5 <= median_ms <= 15


def test_samples_over_http(cloud: Any, wan: Any) -> None:
    """Measured delays apply to an open connection at once, and the link shows how many there are."""
    relay = wan(cloud(echo), *BARE)
    with relay.connect() as client:
        round_trip_s(client)
        link = relay.change(samples=[20, 20.5], distribution="samples")
        assert (link["up"]["samples"], link["down"]["samples"]) == (2, 2)
        median_ms = 1e3 * quietest(lambda: round_trip_s(client), 4)
    print(f"round trip {median_ms:.3f} ms")
    assert 40 <= median_ms <= 46
    status, reply = relay.ask("PUT", "/link", {"samples": [-1]})
    assert (status, reply) == (422, {"detail": "up.samples: -1.0 is not a number from 0 to 60000"})


def test_a_schedule_is_played_in_order(cloud: Any, wan: Any, tmp_path: Path) -> None:
    """The events of a file are played in order of time, at most 100 ms late; GET /schedule counts them."""
    file = tmp_path / "events.toml"
    file.write_text(
        "[[event]]\nat_s = 0.4\ndelay_ms = 3\n[[event]]\nat_s = 0.2\nup = {delay_ms = 2}\n"
        "[[event]]\nat_s = 0.6\nreset = true\n[[event]]\nat_s = 1000\nhang = true\n"
    )
    truth = tmp_path / "link.jsonl"
    relay = wan(cloud(echo), *BARE, "--schedule", str(file), "--truth", str(truth))
    with relay.connect() as client:
        assert is_reset(client)
    wait_until(lambda: relay.ask("GET", "/schedule")[1]["done"] == 3)
    stop(relay)
    found = [line for line in read_record(truth) if line["what"] == "conditions"]
    shown = [(line["by"], line["up"]["delay_ms"], line["down"]["delay_ms"]) for line in found]
    assert shown == [("flag", 0, 0), ("schedule", 2, 0), ("schedule", 3, 3)]
    gaps_s = [found[1]["at_s"], found[2]["at_s"]]
    print(f"played at {gaps_s}")
    start_s = gaps_s[0] - 0.2  # the schedule starts when the relay is ready, the record a moment earlier
    assert 0 <= start_s <= 1
    assert gaps_s[1] - start_s == pytest.approx(0.4, abs=0.1)


def test_a_schedule_over_http(cloud: Any, wan: Any) -> None:
    """POST plays events, GET shows them, DELETE forgets them; a wrong event is named."""
    relay = wan(cloud(echo), *BARE)
    events = [{"at_s": 0, "up": {"delay_ms": 4}}, {"at_s": 500, "hang": True}]
    status, reply = relay.ask("POST", "/schedule", {"event": events[::-1]})
    assert (status, reply["done"], reply["event"]) == (200, 1, events)
    assert relay.ask("GET", "/link")[1]["up"]["delay_ms"] == 4
    bad = relay.ask("POST", "/schedule", {"event": [{"at_s": 0, "delay": 4}]})
    assert bad == (422, {"detail": "event 1: unknown key 'delay'; did you mean 'delay_ms'?"})
    assert relay.ask("GET", "/schedule")[1]["event"] == events
    assert relay.ask("DELETE", "/schedule") == (200, {"now_s": 0, "done": 0, "event": []})
    assert relay.ask("GET", "/link")[1]["up"]["delay_ms"] == 4


@pytest.mark.parametrize(
    ("flag", "text", "message"),
    [
        ("--schedule", "[[event]]\nat_s = 1\nup = {outge = true}\n", ":3: unknown key 'outge'; did you mean"),
        ("--samples", "1\n2\nfast\n", ":3: 'fast' is not a delay in ms from 0 to 60000"),
    ],
)
def test_a_wrong_file_is_a_mistake_of_the_user(tmp_path: Path, flag: str, text: str, message: str) -> None:
    """A wrong file gives exit code 2 and one line with the file, the line and the value."""
    file = tmp_path / "file"
    file.write_text(text)
    command = [sys.executable, "-c", WAN, "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0", flag, str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S)
    assert done.returncode == 2
    assert done.stderr.startswith(f"wan: {file}{message}")
    assert done.stderr.count("\n") == 1
