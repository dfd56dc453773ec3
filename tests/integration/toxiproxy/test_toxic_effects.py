"""The effects of Toxiproxy's toxics on real connections, set by a Toxiproxy client from PyPI."""

import contextlib
import time
from typing import Any

import pytest

from tests.integration.toxiproxy.requests import Greeter, client_of, connect, ended, running
from tests.relays import receive, round_trip_s, silent

pytestmark = pytest.mark.integration

CONNECTIONS = 16


def test_latency_is_added_and_removed(client: Any, upstream: Any) -> None:
    """With 30 ms up and 20 ms down the fastest round trip takes 50 to 53 ms, without toxics up to 3 ms."""
    proxy = client.create(upstream=upstream(), name="echo")
    with connect(proxy) as connection:
        round_trip_s(connection)
        proxy.add_toxic(type="latency", stream="upstream", attributes={"latency": 30})
        proxy.add_toxic(type="latency", attributes={"latency": 20, "jitter": 0})
        both_ms = 1e3 * min(round_trip_s(connection) for _ in range(10))
        assert set(proxy.toxics()) == {"latency_upstream", "latency_downstream"}
        proxy.destroy_toxic("latency_upstream")
        half_ms = 1e3 * min(round_trip_s(connection) for _ in range(10))
        proxy.destroy_toxic("latency_downstream")
        without_ms = 1e3 * min(round_trip_s(connection) for _ in range(10))
    print(f"round trips {both_ms:.2f}, {half_ms:.2f}, {without_ms:.2f} ms")
    assert 50 <= both_ms <= 53
    assert 20 <= half_ms <= 23
    assert without_ms <= 3


def test_jitter_makes_latency_longer_and_shorter(client: Any, upstream: Any) -> None:
    """With 20 ms and a jitter of 10 ms, round trips vary, and the fastest takes 10 to 20 ms."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="latency", attributes={"latency": 20, "jitter": 10})
    times_ms = []
    with contextlib.ExitStack() as stack:
        for _ in range(60):  # a loaded machine adds some milliseconds to most of them
            connection = stack.enter_context(connect(proxy))
            times_ms.append(1e3 * round_trip_s(connection))
    print([round(ms, 1) for ms in times_ms])
    assert 10 <= min(times_ms) < 20
    assert max(times_ms) - min(times_ms) > 5


def test_the_bandwidth_is_limited(client: Any, upstream: Any) -> None:
    """The fastest of three transfers of 200 kB at 500 kB/s takes 0.4 s, up to 15 % more.

    Other load on the machine can only make a transfer slower.
    """
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="bandwidth", attributes={"rate": 500})
    data = bytes(range(250)) * 800
    taken_s = []
    with connect(proxy) as connection:
        for _ in range(3):
            start = time.perf_counter()
            connection.sendall(data)
            assert receive(connection, len(data)) == data
            taken_s.append(time.perf_counter() - start)
    print([f"{s:.3f} s" for s in taken_s])
    assert 0.4 <= min(taken_s) <= 0.46


def test_a_timeout_of_0_is_silence_until_it_is_removed(client: Any, upstream: Any) -> None:
    """Open and new connections receive nothing; removing the toxic closes them all, as in Toxiproxy.

    Connections that are made later work.
    """
    proxy = client.create(upstream=upstream(), name="echo")
    with connect(proxy) as old:
        round_trip_s(old)
        proxy.add_toxic(name="hang", type="timeout", attributes={"timeout": 0})
        with connect(proxy) as new:
            new.sendall(b"ping")
            assert silent(new)
            assert silent(old)
            proxy.destroy_toxic("hang")
            assert ended(old)
            assert ended(new)
    with connect(proxy) as later:
        round_trip_s(later)


def test_a_timeout_closes_the_connection(client: Any, upstream: Any) -> None:
    """With a timeout of 150 ms, a connection receives nothing and is closed after 150 ms or more."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="timeout", attributes={"timeout": 150})
    start = time.perf_counter()
    with connect(proxy) as connection:
        connection.sendall(b"ping")
        assert ended(connection)
    assert time.perf_counter() - start >= 0.15


@pytest.mark.parametrize("timeout_ms", [0, 150])
def test_reset_peer_resets(client: Any, upstream: Any, timeout_ms: int) -> None:
    """After the timeout the connection ends by RST, with no byte before it."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="reset_peer", attributes={"timeout": timeout_ms})
    start = time.perf_counter()
    # With a timeout of 0 the RST may arrive before `connect` returns.
    with pytest.raises(ConnectionResetError), connect(proxy) as connection:
        round_trip_s(connection)
    assert time.perf_counter() - start >= timeout_ms / 1e3


def test_limit_data_ends_the_connection_after_some_bytes(client: Any, upstream: Any) -> None:
    """With a limit of 2,000 bytes, the first 2,000 of 5,000 bytes arrive, then the end."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="limit_data", attributes={"bytes": 2000})
    data = bytes(range(250)) * 20
    with connect(proxy) as connection:
        connection.sendall(data)
        assert receive(connection, len(data)) == data[:2000]


def test_slow_close_delays_only_the_end(client: Any, upstream: Any) -> None:
    """When the upstream closes at once, its bytes arrive at once, and its end 300 ms later."""
    proxy = client.create(upstream=upstream(Greeter), name="greeter")
    proxy.add_toxic(type="slow_close", attributes={"delay": 300})
    with connect(proxy) as connection:
        assert receive(connection, 5) == b"hello"
        came_s = time.perf_counter()
        assert ended(connection)
        after_s = time.perf_counter() - came_s
    print(f"end {after_s:.3f} s after the last byte")
    assert after_s == pytest.approx(0.3, abs=0.15)


@pytest.mark.timeout(40)  # three relays
def test_toxicity_is_drawn_for_each_connection_from_the_seed(upstream: Any) -> None:
    """At a toxicity of 0.5 some connections time out, the same ones for the same seed."""
    where = upstream()

    def timed_out(seed: int) -> list[bool]:
        found = []
        with running("--seed", str(seed)) as port:
            proxy = client_of(port).create(upstream=where, name="echo")
            proxy.add_toxic(type="timeout", toxicity=0.5, attributes={"timeout": 1})
            for _ in range(CONNECTIONS):
                with connect(proxy) as connection:
                    connection.sendall(b"p")
                    found.append(ended(connection))
        return found

    first, again, other = timed_out(1), timed_out(1), timed_out(2)
    print("".join(".x"[hit] for hit in first), "".join(".x"[hit] for hit in other))
    assert first == again
    assert first != other
    assert 0 < sum(first) < CONNECTIONS
