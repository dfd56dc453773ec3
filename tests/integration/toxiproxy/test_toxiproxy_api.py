"""Toxiproxy's API of the relay: proxies and toxics are made, changed and removed; mistakes are refused."""

import json
import socket
import subprocess
from typing import Any

import pytest
from toxiproxy.exceptions import InvalidToxic, NotFound, ProxyExists

from offboard.loadgen.relay.toxiproxy.proxies import PROXIES_MAX, TOXICS_MAX
from offboard.loadgen.relay.toxiproxy.toxiproxy_api import BODY_BYTES_MAX
from tests.integration.toxiproxy.requests import WAN, Greeter, ask, connect, ended
from tests.relays import WAIT_S, receive, round_trip_s

pytestmark = pytest.mark.integration


def test_the_client_creates_lists_and_removes_a_proxy(client: Any, upstream: Any) -> None:
    """A new proxy shows its port and passes bytes; a removed proxy accepts no connections."""
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


def test_a_disabled_proxy_refuses_and_comes_back(client: Any, upstream: Any) -> None:
    """A disabled proxy ends its connections and refuses new ones; later it has the same port and toxics."""
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
    """After a reset every proxy listens on its old port again, without toxics."""
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


def test_the_client_raises_its_own_errors(client: Any, upstream: Any) -> None:
    """The errors of the API make the client raise ProxyExists, InvalidToxic and NotFound."""
    proxy = client.create(upstream=upstream(), name="echo")
    proxy.add_toxic(type="latency", attributes={"latency": 1})
    with pytest.raises(ProxyExists, match="toxic already exists"):
        proxy.add_toxic(type="latency", attributes={"latency": 2})
    with pytest.raises(InvalidToxic, match=r"slicer.* is not one of latency, bandwidth"):
        proxy.add_toxic(type="slicer", attributes={"average_size": 10})
    client.destroy(proxy)
    with pytest.raises(NotFound, match="proxy not found"):
        proxy.toxics()


def test_populate_keeps_matching_proxies_and_replaces_others(api: int, upstream: Any) -> None:
    """An existing proxy with another upstream is replaced by one without toxics; the other one is kept."""
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


def test_a_new_upstream_ends_the_open_connections(client: Any, relay_port: int, upstream: Any) -> None:
    """A proxy with a new upstream ends its open connections, keeps its port, and connects to the new one."""
    proxy = client.create(upstream=upstream(), name="echo")
    with connect(proxy) as old:
        round_trip_s(old)
        where = upstream(Greeter)
        status, shown = ask(relay_port, "PATCH", "/proxies/echo", {"upstream": where})
        assert (status, shown["listen"], shown["upstream"]) == (200, proxy.listen, where)
        assert ended(old)
    with connect(proxy) as new:
        assert receive(new, 5) == b"hello"


def test_a_part_of_a_toxic_can_be_changed(api: int) -> None:
    """POST and PATCH change the given fields and keep the others; unknown attributes are ignored."""
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
def test_wrong_requests_are_refused(
    api: int, method: str, path: str, body: Any, status: int, message: str
) -> None:
    """A wrong request gets the status and the error body of Toxiproxy, and changes nothing."""
    before = ask(api, "GET", "/proxies")
    answered, error = ask(api, method, path, body)
    assert (answered, error["status"]) == (status, status)
    assert error["error"].startswith(message)
    assert ask(api, "GET", "/proxies") == before


def test_a_browser_is_refused(api: int) -> None:
    """A web page cannot control the relay."""
    headers = {"User-Agent": "Mozilla/5.0"}
    assert ask(api, "GET", "/proxies", **headers) == (403, {"error": "User agent not allowed", "status": 403})


def test_a_port_in_use_is_named(api: int) -> None:
    """A proxy that cannot listen is not created, and the error names the port."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = f"127.0.0.1:{taken.getsockname()[1]}"
        body = {"name": "taken", "listen": listen, "upstream": "127.0.0.1:1"}
        status, error = ask(api, "POST", "/proxies", body)
    assert (status, error["error"]) == (500, f"listen: cannot listen on {listen}: Address already in use")
    assert list(ask(api, "GET", "/proxies")[1]) == ["p"]


def test_proxies_and_toxics_are_bounded(api: int) -> None:
    """A proxy or toxic beyond the limit is refused, and the API keeps working."""
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


def test_the_sum_of_latencies_is_bounded(api: int) -> None:
    """A toxic with which the delay would exceed the limit of a link is refused and not added."""
    toxic = {"name": "one", "type": "latency", "attributes": {"latency": 40_000}}
    assert ask(api, "POST", "/proxies/p/toxics", toxic)[0] == 200
    status, error = ask(api, "POST", "/proxies/p/toxics", toxic | {"name": "two"})
    assert status == 400
    assert error["error"].endswith("delay_ms: 80000.0 is not a number from 0 to 60000")
    assert [toxic["name"] for toxic in ask(api, "GET", "/proxies/p/toxics")[1]] == ["one"]


def test_the_api_needs_loopback() -> None:
    """An address beyond loopback is a mistake of the user: one line and exit code 2."""
    command = [*WAN, "--toxiproxy", "0.0.0.0:8474"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S)
    assert done.returncode == 2
    assert done.stderr.startswith("loadgen wan: --toxiproxy: '0.0.0.0:8474' is not on loopback")
    assert done.stderr.count("\n") == 1
