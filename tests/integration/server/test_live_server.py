"""The pages /live and /docs of the server, over real HTTP."""

import json
import time
from collections.abc import Callable, Generator, Iterator
from typing import Any

import httpx
import numpy as np
import pytest

from offboard.cloud_server.http_api import LOOKS_A_STREAM, HttpServer, create_app
from offboard.cloud_server.metrics import ServerLive
from offboard.common.live.live_files import LOOKS, PATHS
from offboard.common.live.look import EVERY_S, VIEWERS_MAX, Look
from tests.integration.server.peers import WAIT_S, Join, Running, Serve

pytestmark = pytest.mark.integration

TOKEN = "a-token-of-the-tests"


class SlowLive(ServerLive):
    """Each look takes 0.8 s, as on a busy machine."""

    def looks(self) -> Generator[Look]:
        for look in super().looks():
            time.sleep(0.8)
            yield look


@pytest.fixture
def web(serve: Serve) -> Iterator[tuple[Running, str]]:
    """A server, and the address of its HTTP with a token."""
    running = serve()
    live = ServerLive(running.metrics, running.server.status, running.server.robots, workers=1)
    app = create_app(running.server.status, running.metrics.registry, {}, token=TOKEN, live=live)
    http = HttpServer(app, ("127.0.0.1", 0))
    http.start()
    yield running, f"http://{http.address}"
    http.close()


def looks(address: str, count: int, between: Callable[[], object] = lambda: None) -> list[Any]:
    """The first looks of a stream. `between` is called after the first one."""
    found: list[Any] = []
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with httpx.stream("GET", f"{address}{LOOKS}", headers=headers, timeout=WAIT_S) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        for line in answer.iter_lines():
            if line:
                found.append(json.loads(line.removeprefix("data: ")))
                if len(found) == 1:
                    between()
                if len(found) == count:
                    break
    return found


def test_pages_are_open_and_their_data_is_not(web: tuple[Running, str]) -> None:
    """The files hold nothing secret; what they show needs the token, as /metrics does beyond loopback."""
    _, address = web
    for path in PATHS:
        answer = httpx.get(f"{address}{path}")
        assert answer.status_code == 200, path
        assert "script-src 'self'" in answer.headers["content-security-policy"]
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "http" not in answer.headers["content-security-policy"]
    for path in (LOOKS, "/openapi.json", "/live/other.js", "/live/"):
        assert httpx.get(f"{address}{path}").status_code == 401, path
    headers = {"Authorization": f"Bearer {TOKEN}"}
    assert httpx.get(f"{address}/live/other.js", headers=headers).status_code == 404


def test_robots_are_counted_while_somebody_looks(web: tuple[Running, str], join: Join) -> None:
    """The second look has the task that came after the first one; a page that asks again still has it."""
    running, address = web
    peer = join(running.server.endpoint)
    assert peer.value(1, "served_sum", np.ones(3)) == 3
    assert running.metrics.robots.counted() == {}

    def ask() -> None:
        assert peer.value(2, "served_sum", np.ones(5)) == 5
        peer.request(3, "no_such_task")
        assert peer.reply().status == "unknown_task"

    first, second = looks(address, 2, ask)
    assert first["source"] == "server"
    assert first["server"]["robots"] == []
    (robot,) = second["server"]["robots"]
    assert (robot["tasks"], robot["refused"], robot["waiting"]) == (1, 1, 0)
    assert robot["run_s"] > 0
    assert ["offboard_server_waiting_requests", {}, 0.0] in second["server"]["samples"]
    (again,) = looks(address, 1)
    assert again["server"]["robots"] == [robot]


def test_a_stream_ends_cleanly_before_its_connection_is_cut(web: tuple[Running, str]) -> None:
    """After LOOKS_A_STREAM looks the answer is complete, so that the page asks again without an error."""
    _, address = web
    begun = time.monotonic()
    assert len(looks(address, LOOKS_A_STREAM + 1)) == LOOKS_A_STREAM
    assert time.monotonic() - begun < LOOKS_A_STREAM * EVERY_S + 1.5


def test_a_stream_with_slow_looks_ends_before_its_connection_is_cut(serve: Serve) -> None:
    """A busy machine makes each look late; the answer is complete all the same."""
    running = serve()
    live = SlowLive(running.metrics, running.server.status, running.server.robots, workers=1)
    app = create_app(running.server.status, running.metrics.registry, {}, token=TOKEN, live=live)
    http = HttpServer(app, ("127.0.0.1", 0))
    http.start()
    try:
        assert 0 < len(looks(f"http://{http.address}", LOOKS_A_STREAM + 1)) < LOOKS_A_STREAM
    finally:
        http.close()


def test_viewers_of_a_server_are_limited(web: tuple[Running, str]) -> None:
    """One page too many gets 503 and a sentence."""
    _, address = web
    headers = {"Authorization": f"Bearer {TOKEN}"}
    with httpx.Client(headers=headers, timeout=WAIT_S) as http:
        opened = [
            http.send(http.build_request("GET", f"{address}{LOOKS}"), stream=True) for _ in range(VIEWERS_MAX)
        ]
        streams = [answer.iter_lines() for answer in opened]
        assert all(next(lines).startswith("data: ") for lines in streams)
        refused = http.get(f"{address}{LOOKS}")
        assert refused.status_code == 503
        assert f"{VIEWERS_MAX} pages are open" in refused.text
        for answer in opened:
            answer.close()
