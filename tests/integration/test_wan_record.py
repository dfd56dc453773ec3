"""The record of what the link did, and the statistics of the link that are computed from it."""

import asyncio
import math
import random
import socket
import statistics
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import scipy.stats

from offboard.loadgen.relay.link.link import SEGMENT_BYTES, Link, LinkConditions
from offboard.loadgen.relay.tcp import forwarder
from offboard.loadgen.relay.tcp.link_record import LinkRecord
from offboard.loadgen.relay.tcp.relay import Relay, RelaySettings
from tests.relays import WAIT_S, echo, quietest, read_record, receive, round_trip_s, stop, wait_until

pytestmark = pytest.mark.integration

BARE = ("--delay-ms", "0", "--bandwidth-mbps", "0")


def test_the_record_is_complete(cloud: Any, wan: Any, tmp_path: Path) -> None:
    """The record holds all bytes of both directions, with no missing segment, and none too early."""
    truth = tmp_path / "link.jsonl"
    flags = ("--delay-ms", "2", "--jitter-ms", "1", "--loss", "0.05", "--stall-ms", "3")
    relay = wan(cloud(echo), *flags, "--bandwidth-mbps", "0", "--truth", str(truth))
    data = bytes(range(256)) * 1200
    for _ in range(2):
        with relay.connect() as client:
            client.sendall(data)
            assert receive(client, len(data)) == data
    wait_until(lambda: relay.ask("GET", "/link")[1]["connections"] == 0)
    relay.change(delay_ms=0)
    counted = relay.ask("GET", "/link")[1]
    stop(relay)
    lines = read_record(truth)
    assert counted["truth"]["dropped"] == 0
    assert lines[-1]["what"] == "end"
    assert lines[-1]["lines"] == counted["truth"]["lines"] == len(lines) - 1
    assert [line["by"] for line in lines if line["what"] == "conditions"] == ["flag", "http"]
    for what, more in (("opened", {}), ("closed", {"how": "client"})):
        found = [line for line in lines if line["what"] == what]
        assert [line["connection"] for line in found] == [1, 2]
        assert all(line.items() >= more.items() for line in found)
    chunks = [line for line in lines if line["what"] == "chunk"]
    for direction in ("up", "down"):
        for connection in (1, 2):
            check_stream(
                [c for c in chunks if (c["connection"], c["direction"]) == (connection, direction)], len(data)
            )
        assert counted[f"bytes_{direction}"] == 2 * len(data)


def check_stream(chunks: list[dict[str, Any]], size: int) -> None:
    """The chunks of a stream hold all bytes and then the end, in order, and none came before it was due."""
    at = 0
    for chunk in chunks:
        assert chunk["segment"] == at // SEGMENT_BYTES
        at += chunk["bytes"]
        late_s = (chunk["drawn_ms"] + chunk["stall_ms"]) / 1e3
        assert chunk["due_s"] >= chunk["arrived_s"] + late_s - 2e-6
        assert chunk["delivered_s"] >= chunk["due_s"] - 2e-6
    assert at == size
    assert chunks[-1]["bytes"] == 0
    assert any(chunk["stall_ms"] for chunk in chunks)
    assert [c["delivered_s"] for c in chunks] == sorted(c["delivered_s"] for c in chunks)


@pytest.mark.parametrize("distribution", ["normal", "lognormal", "pareto"])
def test_drawn_delays_have_the_named_distribution(
    cloud: Any, wan: Any, tmp_path: Path, distribution: str
) -> None:
    """The delays of the segments pass the Kolmogorov-Smirnov test against the named distribution.

    The record also holds the delays that were achieved: no chunk came earlier than its drawn delay.
    """
    truth = tmp_path / "link.jsonl"
    shape = ("--delay-ms", "30", "--jitter-ms", "4", "--distribution", distribution, "--seed", "11")
    relay = wan(cloud(echo), *shape, "--bandwidth-mbps", "0", "--truth", str(truth))
    with relay.connect() as client:
        sender = threading.Thread(target=client.sendall, args=(bytes(4000 * SEGMENT_BYTES),))
        sender.start()
        receive(client, 4000 * SEGMENT_BYTES)
        sender.join()
    stop(relay)
    chunks = [line for line in read_record(truth) if line["what"] == "chunk" and line["bytes"]]
    drawn = {(chunk["direction"], chunk["segment"]): chunk["drawn_ms"] for chunk in chunks}
    theory = {
        "normal": scipy.stats.norm(30, 4),
        "lognormal": scipy.stats.lognorm(1, loc=30, scale=4 / 2.1611974158950877),
        "pareto": scipy.stats.lomax(3, loc=30, scale=4 / 0.8660254037844386),
    }
    assert len(drawn) == 8000
    for direction in ("up", "down"):
        delays = [drawn[direction, n] for n in range(4000)]
        p = scipy.stats.kstest(delays, theory[distribution].cdf).pvalue
        print(f"{direction}: p = {p:.3f}")
        assert p > 0.001
    achieved_ms = [1e3 * (chunk["delivered_s"] - chunk["arrived_s"]) for chunk in chunks]
    late_ms = [1e3 * (chunk["delivered_s"] - chunk["due_s"]) for chunk in chunks]
    print(f"achieved {statistics.median(achieved_ms):.3f} ms, late by {statistics.median(late_ms):.3f} ms")
    assert all(ms >= chunk["drawn_ms"] - 2e-3 for ms, chunk in zip(achieved_ms, chunks, strict=True))
    assert min(late_ms) >= -2e-3


@pytest.mark.parametrize("burst", [1, 4])
def test_the_share_of_stalled_segments_is_the_loss(cloud: Any, wan: Any, tmp_path: Path, burst: int) -> None:
    """At 2 % loss, the number of stalled segments in the record is within its 99.9 % binomial interval.

    With bursts the interval is wider, because neighbouring segments are correlated.
    """
    truth = tmp_path / "link.jsonl"
    flags = ("--loss", "0.02", "--loss-burst", str(burst), "--stall-ms", "1", "--seed", "7")
    relay = wan(cloud(echo), *BARE, *flags, "--truth", str(truth))
    size = 8000 * SEGMENT_BYTES
    with relay.connect() as client:
        sender = threading.Thread(target=client.sendall, args=(bytes(size),))
        sender.start()
        assert len(receive(client, size)) == size
        sender.join()
    stop(relay)
    first = of_segments(read_record(truth))
    memory = 1 - (0.02 / 0.98 + 1) / burst if burst > 1 else 0.0  # correlation of neighbouring segments
    spread = math.sqrt((1 + memory) / (1 - memory))
    for direction in ("up", "down"):
        stalled = sum(stall_ms > 0 for _drawn_ms, stall_ms in first[direction].values())
        low, high = scipy.stats.binom.interval(0.999, 8000, 0.02)
        print(f"{direction}: {stalled} of 8000 segments stalled, {low:.0f} to {high:.0f}, times {spread:.2f}")
        assert len(first[direction]) == 8000
        assert 160 - spread * (160 - low) <= stalled <= 160 + spread * (high - 160)


def of_segments(lines: list[dict[str, Any]]) -> dict[str, dict[int, tuple[float, float]]]:
    """By direction and segment, the delay and the stall of the first byte."""
    found: dict[str, dict[int, tuple[float, float]]] = {"up": {}, "down": {}}
    for line in lines:
        if line["what"] == "chunk" and line["bytes"]:
            found[line["direction"]].setdefault(line["segment"], (line["drawn_ms"], line["stall_ms"]))
    return found


@pytest.mark.timeout(40)  # three relays
def test_the_same_bytes_meet_the_same_link(cloud: Any, wan: Any, tmp_path: Path) -> None:
    """Two relays with the same seed draw the same delay and stall for every segment of two connections.

    It does not matter whether the bytes come at once or in small messages. Another seed draws others.
    """
    size = 60 * SEGMENT_BYTES
    shape = ("--jitter-ms", "0.3", "--distribution", "pareto", "--correlation", "0.3")
    shape += ("--loss", "0.1", "--loss-burst", "3", "--stall-ms", "0.5")

    def run(seed: int, most: int) -> list[dict[str, Any]]:
        truth = tmp_path / f"{seed}-{most}.jsonl"
        relay = wan(cloud(echo), *BARE, *shape, "--seed", str(seed), "--truth", str(truth))
        sizes = random.Random(seed)
        for _ in range(2):
            with relay.connect() as client:
                left = size
                while left:
                    part = min(left, most, sizes.randint(1, 2 * most))
                    client.sendall(bytes(part))
                    assert len(receive(client, part)) == part
                    left -= part
        stop(relay)
        return read_record(truth)

    whole, cut, other = run(3, size), run(3, 2000), run(4, size)
    counts = [sum(line["what"] == "chunk" for line in lines) for lines in (whole, cut)]
    print(f"{counts} chunks")
    assert counts[1] > 1.2 * counts[0]
    for number in (1, 2):
        drawn = [
            of_segments([line for line in lines if line.get("connection") == number])
            for lines in (whole, cut, other)
        ]
        assert len(drawn[0]["up"]) == len(drawn[0]["down"]) == 60
        assert drawn[0] == drawn[1]
        assert drawn[0] != drawn[2]


def test_lost_bytes_are_marked_in_the_record(cloud: Any, wan: Any, tmp_path: Path) -> None:
    """Bytes that are under way when the relay stops have a delivered_s of null in the record."""
    truth = tmp_path / "link.jsonl"
    relay = wan(cloud(echo), "--delay-ms", "30000", "--truth", str(truth))
    with relay.connect() as client:
        client.sendall(b"lost")
        wait_until(lambda: relay.ask("GET", "/link")[1]["connections"] == 1)
        time.sleep(0.05)
        stop(relay)
    lines = read_record(truth)
    chunks = [(line["bytes"], line["delivered_s"]) for line in lines if line["what"] == "chunk"]
    assert chunks[0] == (4, None)
    assert [line["how"] for line in lines if line["what"] == "closed"] == ["stopped"]


@pytest.mark.alone  # it measures times
def test_the_record_does_not_change_the_delay(cloud: Any, wan: Any, tmp_path: Path) -> None:
    """With a record and 15 ms in each direction, the median round trip still takes 30 to 31.5 ms."""
    relay = wan(cloud(echo), "--delay-ms", "15", "--truth", str(tmp_path / "link.jsonl"))
    with relay.connect() as client:
        median_ms = 1e3 * quietest(lambda: round_trip_s(client))
    print(f"round trip {median_ms:.3f} ms")
    assert 30.0 <= median_ms <= 31.5


def test_chunks_under_way_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The relay stops reading when CHUNKS_MAX chunks are under way, and all bytes arrive in the end."""
    monkeypatch.setattr(forwarder, "CHUNKS_MAX", 8)
    path = tmp_path / "link.jsonl"

    async def play() -> bytes:
        loop = asyncio.get_running_loop()
        got: asyncio.Future[bytes] = loop.create_future()

        async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            got.set_result(await reader.read(-1))
            writer.close()

        cloud = await asyncio.start_server(talk, "127.0.0.1", 0)
        record = LinkRecord(path, loop.time())
        link = Link(up=LinkConditions(delay_ms=500))
        settings = RelaySettings(seed=0, connections_max=1, buffer_bytes=1 << 20)
        relay = Relay(cloud.sockets[0].getsockname(), link, settings, record=record)
        server = await loop.create_server(relay.accept, "127.0.0.1", 0)
        with socket.create_connection(server.sockets[0].getsockname()) as client:
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for _ in range(30):
                client.send(b"x")
                await asyncio.sleep(0.005)
        heard = await asyncio.wait_for(got, WAIT_S)
        await relay.ended(WAIT_S)
        record.close(loop.time())
        server.close()
        cloud.close()
        return heard

    assert asyncio.run(play()) == b"x" * 30
    chunks = [line for line in read_record(path) if line["what"] == "chunk" and line["bytes"]]
    changes = [(chunk["arrived_s"], 1) for chunk in chunks] + [(chunk["delivered_s"], -1) for chunk in chunks]
    under_way, most = 0, 0
    for _at_s, change in sorted(changes):
        under_way += change
        most = max(most, under_way)
    assert most == 8
