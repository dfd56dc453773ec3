"""Toxiproxy's API of the relay, driven by a Toxiproxy client from PyPI, with its effects on real sockets."""

import contextlib
import http.client
import json
import re
import socket
import socketserver
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import toxiproxy
from toxiproxy.exceptions import InvalidToxic, NotFound, ProxyExists

from offboard.loadgen.relay.toxiproxy.proxies import PROXIES_MAX, TOXICS_MAX
from offboard.loadgen.relay.toxiproxy.toxiproxy_api import BODY_BYTES_MAX
from tests.relays import WAIT_S, receive, round_trip_s, silent

pytestmark = pytest.mark.integration

WAN = [sys.executable, "-m", "offboard.loadgen", "wan", "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"]
CONNECTIONS = 16


class Echo(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with contextlib.suppress(OSError):
            while data := self.request.recv(65536):
                self.request.sendall(data)


class Greeter(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        self.request.sendall(b"hello")


@pytest.fixture
def upstream() -> Iterator[Callable[..., str]]:
    """Factory: a TCP server in threads; returns its HOST:PORT."""
    with contextlib.ExitStack() as stack:

        def serve(talk: type[socketserver.BaseRequestHandler] = Echo) -> str:
            server = stack.enter_context(socketserver.ThreadingTCPServer(("127.0.0.1", 0), talk))
            thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
            thread.start()
            stack.callback(thread.join)
            stack.callback(server.shutdown)
            return f"127.0.0.1:{server.server_address[1]}"

        yield serve


@contextlib.contextmanager
def running(*flags: str) -> Iterator[int]:
    """A relay process; the port of its Toxiproxy API."""
    command = [*WAN, "--toxiproxy", "127.0.0.1:0", *flags]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield int(re.findall(r":(\d+)", process.stdout.readline())[-1])
        process.terminate()
        assert process.wait(WAIT_S) == 0


@pytest.fixture(scope="module")
def bench() -> Iterator[int]:
    """One relay for all tests, the port of its API."""
    with running() as port:
        yield port


@pytest.fixture
def client(bench: int) -> Iterator[toxiproxy.Toxiproxy]:
    """The third-party client of a relay that has no proxies yet."""
    client = client_of(bench)
    yield client
    client.destroy_all()


@pytest.fixture
def api(bench: int, client: toxiproxy.Toxiproxy) -> int:
    """The same relay's port, with the proxy `p`, which leads nowhere."""
    client.create(upstream="127.0.0.1:1", name="p")
    return bench


def client_of(port: int) -> toxiproxy.Toxiproxy:
    client = toxiproxy.Toxiproxy()
    client.update_api_consumer("127.0.0.1", port)
    return client


def ask(port: int, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, Any]:
    """Status and body of a request without a content type, as some clients make it."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)
    with contextlib.closing(connection):
        text = body if body is None or isinstance(body, str) else json.dumps(body)
        connection.request(method, path, text, headers)
        reply = connection.getresponse()
        data = reply.read()
        return reply.status, json.loads(data) if data else None


def connect(proxy: Any) -> socket.socket:
    host, port = proxy.listen.split(":")
    connection = socket.create_connection((host, int(port)), timeout=WAIT_S)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def ended(connection: socket.socket) -> bool:
    """The end comes, without a byte before it."""
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


def test_the_client_makes_lists_and_removes_a_proxy(client: Any, upstream: Any) -> None:
    """A proxy is created on a port of its own, which is shown; bytes pass; destroyed it takes none."""
    assert json.loads(client.version())["version"].startswith("2.")
    assert client.proxies() == {}
    where = upstream()
    proxy = client.create(upstream=where, name="echo")
    assert (proxy.name, proxy.upstream, proxy.enabled) == ("echo", where, True)
    assert int(proxy.listen.removeprefix("127.0.0.1:")) > 0
    assert [vars(shown) for shown in client.proxies().values()] == [vars(proxy)]
    with connect(proxy) as connection:
        round_trip_s(connection)
        assert client.destroy(proxy)
        assert ended(connection)
    assert client.proxies() == {}
    with pytest.raises(ConnectionRefusedError):
        connect(proxy)


def test_latency_is_added_and_taken_away(client: Any, upstream: Any) -> None:
    """30 ms up and 20 ms down make an open connection's round trips 50 ms, at most 3 ms more at the
    quietest; with the toxics removed it is quick again."""
    proxy = client.create(upstream=upstream(), name="echo")
    with connect(proxy) as connection:
        round_trip_s(connection)
        proxy.add_toxic(type="latency", stream="upstream", attributes={"latency": 30})
        proxy.add_toxic(type="latency", attributes={"latency": 20, "jitter": 0})
        slow_ms = 1e3 * min(round_trip_s(connection) for _ in range(10))
        assert set(proxy.toxics()) == {"latency_upstream", "latency_downstream"}
        proxy.destroy_toxic("latency_upstream")
        half_ms = 1e3 * min(round_trip_s(connection) for _ in range(10))
        proxy.destroy_toxic("latency_downstream")
        quick_ms = 1e3 * min(round_trip_s(connection) for _ in range(10))
    print(f"round trips {slow_ms:.2f}, {half_ms:.2f}, {quick_ms:.2f} ms")
    assert 50 <= slow_ms <= 53
    assert 20 <= half_ms <= 23
    assert quick_ms <= 3


def test_jitter_is_either_way(client: Any, upstream: Any) -> None:
    """20 ms with a jitter of 10 ms are never less than 10, sometimes less than 20, and differ."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="latency", attributes={"latency": 20, "jitter": 10})
    times_ms = []
    with contextlib.ExitStack() as stack:
        for _ in range(20):
            connection = stack.enter_context(connect(proxy))
            times_ms.append(1e3 * round_trip_s(connection))
    print([round(ms, 1) for ms in times_ms])
    assert 10 <= min(times_ms) < 20
    assert max(times_ms) - min(times_ms) > 5


def test_bandwidth_is_kept(client: Any, upstream: Any) -> None:
    """200 kB at 500 KB/s take 0.4 s on their way down: never less, in the quickest of three at most 15 %
    more, for other load on the machine only ever adds."""
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


def test_timeout_zero_is_silence_until_it_is_removed(client: Any, upstream: Any) -> None:
    """Open and new connections hear nothing; as in Toxiproxy they are closed when the toxic goes, one that
    had nothing to say too, and later ones are served."""
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


def test_timeout_closes_the_connection_after_it(client: Any, upstream: Any) -> None:
    """With a timeout of 150 ms a connection hears nothing and is closed no sooner than that."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="timeout", attributes={"timeout": 150})
    start = time.perf_counter()
    with connect(proxy) as connection:
        connection.sendall(b"ping")
        assert ended(connection)
    assert time.perf_counter() - start >= 0.15


@pytest.mark.parametrize("timeout_ms", [0, 150])
def test_reset_peer_resets(client: Any, upstream: Any, timeout_ms: int) -> None:
    """The connection ends by RST, no sooner than the timeout, and nothing comes before it."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="reset_peer", attributes={"timeout": timeout_ms})
    start = time.perf_counter()
    # The RST of 0 may come before the connect has returned.
    with pytest.raises(ConnectionResetError), connect(proxy) as connection:
        round_trip_s(connection)
    assert time.perf_counter() - start >= timeout_ms / 1e3


def test_limit_data_ends_the_connection_after_so_many_bytes(client: Any, upstream: Any) -> None:
    """Of 5,000 bytes the first 2,000 arrive, then the end."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="limit_data", attributes={"bytes": 2000})
    data = bytes(range(250)) * 20
    with connect(proxy) as connection:
        connection.sendall(data)
        assert receive(connection, len(data)) == data[:2000]


def test_slow_close_delays_the_end_alone(client: Any, upstream: Any) -> None:
    """The upstream closes at once: its bytes come at once, its end 300 ms later."""
    proxy = client.create(upstream=upstream(Greeter), name="greeter")
    proxy.add_toxic(type="slow_close", attributes={"delay": 300})
    with connect(proxy) as connection:
        assert receive(connection, 5) == b"hello"
        came_s = time.perf_counter()
        assert ended(connection)
        after_s = time.perf_counter() - came_s
    print(f"end {after_s:.3f} s after the last byte")
    assert after_s == pytest.approx(0.3, abs=0.15)


def test_a_proxy_that_is_down_refuses_and_comes_back(client: Any, upstream: Any) -> None:
    """Disabled, its connections end and new ones are refused; enabled, it has the same port and toxics."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="latency", attributes={"latency": 1})
    with connect(proxy) as connection:
        round_trip_s(connection)
        with proxy.down():
            assert ended(connection)
            with pytest.raises(ConnectionRefusedError):
                connect(proxy)
            assert client.get_proxy("echo").enabled is False
    with connect(proxy) as connection:
        round_trip_s(connection)
    assert vars(client.get_proxy("echo")) == vars(proxy)
    assert list(proxy.toxics()) == ["latency_downstream"]


def test_reset_enables_all_and_removes_toxics(client: Any, upstream: Any) -> None:
    """After a reset every proxy listens again where it did, without toxics."""
    where = upstream()
    proxies = [client.create(upstream=where, name=name) for name in ("one", "two")]
    proxies[0].add_toxic(type="latency", attributes={"latency": 2000})
    proxies[1].disable()
    assert client.reset()
    for proxy in proxies:
        assert client.get_proxy(proxy.name).enabled
        assert proxy.toxics() == {}
        with connect(proxy) as connection:
            assert round_trip_s(connection) == pytest.approx(0, abs=1)


def test_the_client_names_what_is_wrong(client: Any, upstream: Any) -> None:
    """The client raises its own errors for a name taken, a toxic unknown, a proxy gone."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="latency", attributes={"latency": 1})
    with pytest.raises(ProxyExists, match="toxic already exists"):
        proxy.add_toxic(type="latency", attributes={"latency": 2})
    with pytest.raises(InvalidToxic, match=r"slicer.* is not one of latency, bandwidth"):
        proxy.add_toxic(type="slicer", attributes={"average_size": 10})
    client.destroy(proxy)
    with pytest.raises(NotFound, match="proxy not found"):
        proxy.toxics()


def test_populate_keeps_what_fits_and_replaces_the_rest(api: int, upstream: Any) -> None:
    """Of two proxies that are there, the one with another upstream is made anew, without its toxics."""
    first, second = upstream(), upstream(Greeter)
    wanted = [{"name": name, "listen": "localhost:0", "upstream": first} for name in ("kept", "replaced")]
    status, made = ask(api, "POST", "/populate", wanted)
    assert (status, [proxy["name"] for proxy in made["proxies"]]) == (201, ["kept", "replaced"])
    for name in ("kept", "replaced"):
        ask(api, "POST", f"/proxies/{name}/toxics", {"type": "latency", "attributes": {"latency": 1}})
    wanted[1]["upstream"] = second
    again = ask(api, "POST", "/populate", wanted)[1]["proxies"]
    assert again[0]["listen"] == made["proxies"][0]["listen"]
    assert [len(proxy["toxics"]) for proxy in again] == [1, 0]
    with socket.create_connection(again[1]["listen"].split(":"), timeout=WAIT_S) as connection:
        assert receive(connection, 5) == b"hello"


def test_another_upstream_drops_connections_and_leads_there(client: Any, bench: int, upstream: Any) -> None:
    """A proxy whose upstream is changed ends what was open, keeps its port, and leads elsewhere."""
    proxy = client.create(upstream=upstream(), name="echo")
    with connect(proxy) as old:
        round_trip_s(old)
        where = upstream(Greeter)
        status, shown = ask(bench, "PATCH", "/proxies/echo", {"upstream": where})
        assert (status, shown["listen"], shown["upstream"]) == (200, proxy.listen, where)
        assert ended(old)
    with connect(proxy) as new:
        assert receive(new, 5) == b"hello"


def test_a_toxic_is_changed_in_part(api: int) -> None:
    """POST and PATCH change what they name and keep the rest; unknown attributes are ignored."""
    new = {"type": "latency", "attributes": {"latency": 100, "jitter": 5, "latncy": 3}, "toxicity": 0.5}
    made = {
        "name": "latency_downstream",
        "type": "latency",
        "stream": "downstream",
        "toxicity": 0.5,
        "attributes": {"latency": 100, "jitter": 5},
    }
    assert ask(api, "POST", "/proxies/p/toxics", new) == (200, made)
    path = "/proxies/p/toxics/latency_downstream"
    made["attributes"]["latency"] = 7
    assert ask(api, "POST", path, {"attributes": {"latency": 7}, "type": "timeout"}) == (200, made)
    made["toxicity"] = 1
    assert ask(api, "PATCH", path, {"toxicity": 1.0}) == (200, made)
    assert ask(api, "GET", path) == (200, made)
    assert ask(api, "DELETE", path) == (204, None)
    assert ask(api, "GET", "/proxies/p/toxics") == (200, [])


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "message"),
    [
        ("GET", "/proxies/q", None, 404, "proxy not found"),
        ("POST", "/proxies/q", {"enabled": False}, 404, "proxy not found"),
        ("DELETE", "/proxies/q", None, 404, "proxy not found"),
        ("POST", "/proxies/q/toxics", {"type": "latency"}, 404, "proxy not found"),
        ("DELETE", "/proxies/p/toxics/t", None, 404, "toxic not found"),
        ("POST", "/proxies/p/toxics/t", {}, 404, "toxic not found"),
        ("GET", "/nothing", None, 404, "Not Found"),
        ("POST", "/proxies", {"name": "p", "upstream": "127.0.0.1:2"}, 409, "proxy already exists"),
        ("POST", "/proxies", "{", 400, "bad request body: Invalid JSON"),
        ("POST", "/proxies", "", 400, "bad request body: Invalid JSON"),
        ("POST", "/proxies", {"upstream": "127.0.0.1:1"}, 400, "missing required field: name"),
        ("POST", "/proxies", {"name": "q"}, 400, "missing required field: upstream"),
        ("POST", "/proxies", {"name": "q", "upstream": "nowhere"}, 400, "bad request body: upstream: 'now"),
        ("POST", "/proxies", {"name": "q", "upstream": 7}, 400, "bad request body: upstream: Input should"),
        ("POST", "/proxies/p", {"enabled": "no"}, 400, "bad request body: enabled: Input should be"),
        ("POST", "/populate", {"name": "q"}, 400, "bad request body: Input should be a valid array"),
        ("POST", "/proxies", "[" * (BODY_BYTES_MAX + 1), 413, "request body: longer than 65536 bytes"),
        ("POST", "/proxies/p/toxics", {"type": "latency", "stream": "up"}, 400, "stream was invalid, can"),
        ("POST", "/proxies/p/toxics", {"type": "jam"}, 400, "invalid toxic type: 'jam' is not one of lat"),
        ("POST", "/proxies/p/toxics", {"type": "latency", "toxicity": 2}, 400, "bad request body: toxicity"),
        (
            "POST",
            "/proxies/p/toxics",
            {"type": "latency", "attributes": {"latency": "1s"}},
            400,
            "bad request body: latency: '1s' is not a whole number from 0 to 60000",
        ),
    ],
)
def test_what_cannot_be_done_is_refused(
    api: int, method: str, path: str, body: Any, status: int, message: str
) -> None:
    """A request that cannot be done has Toxiproxy's status and error body, and changes nothing."""
    before = ask(api, "GET", "/proxies")
    answered, error = ask(api, method, path, body)
    assert (answered, error["status"]) == (status, status)
    assert error["error"].startswith(message)
    assert ask(api, "GET", "/proxies") == before


def test_a_browser_is_refused(api: int) -> None:
    """A web page cannot command the relay."""
    headers = {"User-Agent": "Mozilla/5.0"}
    assert ask(api, "GET", "/proxies", **headers) == (403, {"error": "User agent not allowed", "status": 403})


def test_a_port_in_use_is_an_error_that_names_it(api: int) -> None:
    """A proxy that cannot listen is not made."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = f"127.0.0.1:{taken.getsockname()[1]}"
        body = {"name": "taken", "listen": listen, "upstream": "127.0.0.1:1"}
        status, error = ask(api, "POST", "/proxies", body)
    assert (status, error["error"]) == (500, f"listen: cannot listen on {listen}: Address already in use")
    assert list(ask(api, "GET", "/proxies")[1]) == ["p"]


def test_proxies_and_toxics_are_bounded(api: int) -> None:
    """Beyond the most there may be, another one is refused and the API goes on."""
    for number in range(1, PROXIES_MAX):
        body = {"name": f"p{number}", "upstream": "127.0.0.1:1", "enabled": False}
        assert ask(api, "POST", "/proxies", body)[0] == 201
    status, error = ask(api, "POST", "/proxies", {"name": "more", "upstream": "127.0.0.1:1"})
    assert (status, error["error"]) == (400, f"too many proxies: at most {PROXIES_MAX} are allowed")
    for number in range(TOXICS_MAX):
        body = {"name": f"t{number}", "type": "latency", "attributes": {"latency": 1}}
        assert ask(api, "POST", "/proxies/p/toxics", body)[0] == 200
    status, error = ask(api, "POST", "/proxies/p/toxics", {"name": "more", "type": "latency"})
    assert (status, error["error"]) == (400, f"too many toxics: a proxy may have at most {TOXICS_MAX}")


def test_latencies_together_are_bounded(api: int) -> None:
    """A toxic that would take a stream past what a link can do is refused, and is not there."""
    toxic = {"name": "one", "type": "latency", "attributes": {"latency": 40_000}}
    assert ask(api, "POST", "/proxies/p/toxics", toxic)[0] == 200
    status, error = ask(api, "POST", "/proxies/p/toxics", toxic | {"name": "two"})
    assert status == 400
    assert error["error"].endswith("delay_ms: 80000.0 is not a number from 0 to 60000")
    assert [toxic["name"] for toxic in ask(api, "GET", "/proxies/p/toxics")[1]] == ["one"]


@pytest.mark.timeout(40)  # three relays
def test_toxicity_is_drawn_for_each_connection_from_the_seed(upstream: Any) -> None:
    """With a toxicity of one half some connections time out and some do not: the same ones in two runs
    of one seed, others with another seed."""
    where = upstream()

    def struck(seed: int) -> list[bool]:
        found = []
        with running("--seed", str(seed)) as port:
            proxy = client_of(port).create(upstream=where, name="echo")
            proxy.add_toxic(type="timeout", toxicity=0.5, attributes={"timeout": 1})
            for _ in range(CONNECTIONS):
                with connect(proxy) as connection:
                    connection.sendall(b"p")
                    found.append(ended(connection))
        return found

    first, again, other = struck(1), struck(1), struck(2)
    print("".join(".x"[hit] for hit in first), "".join(".x"[hit] for hit in other))
    assert first == again
    assert first != other
    assert 0 < sum(first) < CONNECTIONS


def test_only_loopback_may_command() -> None:
    """Another address than loopback is a mistake of the user: one line, exit code 2."""
    command = [*WAN, "--toxiproxy", "0.0.0.0:8474"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S)
    assert done.returncode == 2
    assert done.stderr.startswith("loadgen wan: --toxiproxy: '0.0.0.0:8474' is not on loopback")
    assert done.stderr.count("\n") == 1
