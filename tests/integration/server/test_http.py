"""The HTTP side of the server, and addresses that are in use."""

import socket
import threading
import time
from contextlib import closing
from dataclasses import replace
from http.client import HTTPResponse

import httpx
import numpy as np
import pytest

from offboard.cloud_server.http_api import HttpServer, create_app
from offboard.cloud_server.metrics import Metrics, Status
from offboard.cloud_server.server import Limits, Server
from offboard.common import VERSION
from offboard.common.errors import ConfigError
from offboard.common.security import bounded_http
from tests.integration.server.peers import WAIT_S, Join, Serve

pytestmark = pytest.mark.integration


def test_http_shows_the_server(serve: Serve, join: Join) -> None:
    """Health, readiness, metrics, settings, tasks and docs are served; after `close` the thread is gone."""
    running = serve()
    stalled = False

    def status() -> Status:
        now = running.server.status()
        return replace(now, last_turn_age_s=60.0) if stalled else now

    web = HttpServer(create_app(status, running.metrics.registry, {"workers": 1}), ("127.0.0.1", 0))
    web.start()
    assert join(running.server.endpoint).value(1, "served_sum", np.ones(5)) == 5
    with httpx.Client(base_url=f"http://{web.address}", timeout=WAIT_S) as http:
        health = http.get("/health")
        assert health.status_code == 200
        shown = health.json()
        assert shown["healthy"] is True
        assert shown["queue_depth"] == 0
        assert 0 <= shown["last_task_age_s"] <= shown["uptime_s"]
        assert shown["version"] == VERSION
        assert http.get("/ready").status_code == 200
        metrics = http.get("/metrics").text
        assert 'offboard_server_requests_total{kind="served_sum",status="ok"} 1.0' in metrics
        assert 'offboard_server_run_seconds_count{kind="served_sum"} 1.0' in metrics
        assert http.get("/config").json() == {"workers": 1}
        task = next(task for task in http.get("/tasks").json() if task["name"] == "served_sum")
        assert task["duplicate"] is False
        assert len(task["source_hash"]) == 64
        assert http.get("/docs").status_code == 200
        running.close()
        stalled = True
        assert http.get("/health").status_code == 503
        assert http.get("/ready").status_code == 503
    web.close()
    assert not any(thread.name == "web" for thread in threading.enumerate())


def test_a_port_in_use_is_a_config_error(serve: Serve) -> None:
    """For both sockets the error names flag and address."""
    running = serve()
    limits = Limits(1, blob_bytes_max=1, message_bytes_max=1, robot_bytes_per_s=1, drain_s=1.0)
    with pytest.raises(ConfigError, match=r"--listen: 'tcp://127.0.0.1:\d+' cannot be bound: Address"):
        Server(running.server.endpoint, running.pool, Metrics(), limits)
    first = HttpServer(create_app(running.server.status, running.metrics.registry, {}), ("127.0.0.1", 0))
    port = int(first.address.rpartition(":")[2])
    with pytest.raises(ConfigError, match=f"--http: 127.0.0.1:{port} cannot be bound: Address"):
        HttpServer(create_app(running.server.status, running.metrics.registry, {}), ("127.0.0.1", port))
    first.close()


def status_of(connection: socket.socket) -> int:
    """The status of the next answer, which is read to its end."""
    answer = HTTPResponse(connection)
    answer.begin()
    answer.read()
    return answer.status


def test_a_request_has_its_full_time_on_a_connection_that_was_silent(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit counts from its first byte, not from the start of the connection or from the last answer."""
    monkeypatch.setattr(bounded_http, "REQUEST_S", 4.0)
    running = serve()
    app = create_app(running.server.status, running.metrics.registry, {})
    with closing(HttpServer(app, ("127.0.0.1", 0))) as web:
        web.start()
        port = int(web.address.rpartition(":")[2])
        new, used = (socket.create_connection(("127.0.0.1", port), timeout=WAIT_S) for _ in range(2))
        with new, used:
            used.sendall(b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert status_of(used) == 200
            time.sleep(2.5)
            for one in (new, used):
                one.sendall(b"GET /health HTTP/1.1\r\n")
            time.sleep(2.5)
            for one in (new, used):
                one.sendall(b"Host: localhost\r\n\r\n")
                assert status_of(one) == 200
