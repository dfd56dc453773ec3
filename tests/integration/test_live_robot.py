"""The pages of a robot's `metrics` port, over real HTTP, next to real sites."""

import json
import socket
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from offboard.common.live.live_files import LOOKS
from offboard.common.live.live_port import LivePort
from offboard.common.live.look import RobotLive
from tests.probes import echo

pytestmark = pytest.mark.integration


def free_address() -> str:
    with socket.create_server(("127.0.0.1", 0)) as found:
        return f"127.0.0.1:{found.getsockname()[1]}"


def looks(address: str) -> Any:
    """The looks of a new viewer, one by one."""
    with httpx.stream("GET", f"http://{address}{LOOKS}", timeout=10) as answer:
        assert answer.status_code == 200
        for line in answer.iter_lines():
            if line:
                yield json.loads(line.removeprefix("data: "))


def test_the_page_shows_tasks_sites_and_budget(
    testbed: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    """A viewer gets the tasks so far, how each site is, and what may be spent; then what is new."""
    address = free_address()
    offload = connect(testbed(), metrics=address)
    offload(echo, "one", where="cloud")
    seen = looks(address)
    first = next(seen)
    assert first["source"] == "robot"
    assert [task["used"] for task in first["tasks"]] == ["cloud"]
    assert first["sites"].keys() == {"onboard", "cloud"}
    assert first["sites"]["cloud"]["absent"] is None
    assert first["budget"].keys() == {"duplicates", "bytes_left", "joules_left"}
    assert first["budget"]["bytes_left"] is None
    offload(echo, "two", where="onboard")
    used = [task["used"] for look in (next(seen), next(seen)) for task in look["tasks"]]
    assert used == ["onboard"]
    seen.close()


def test_a_silent_server_is_shown_within_two_seconds(
    testbed: Callable[..., Any], connect: Callable[..., Any]
) -> None:
    """Of three looks after the start of an outage, which take at most two seconds, the last one shows it."""
    address, bed = free_address(), testbed()
    offload = connect(bed, metrics=address)
    offload(echo, "one", where="cloud")
    seen = looks(address)
    assert not next(seen)["sites"]["cloud"]["silent"]
    bed.set_link(outage=True)
    after = [next(seen)["sites"]["cloud"]["silent"] for _ in range(3)]
    assert after[-1], after
    seen.close()


def test_metrics_and_foreign_pages(testbed: Callable[..., Any], connect: Callable[..., Any]) -> None:
    """/metrics is served as before; a web page of another site reads neither tasks nor metrics."""
    address = free_address()
    offload = connect(testbed(), metrics=address)
    offload(echo, "one", where="onboard")
    text = httpx.get(f"http://{address}/metrics").text
    assert 'offboard_robot_tasks_total{kind="echo",site="onboard"} 1.0' in text
    assert httpx.get(f"http://{address}/live").status_code == 200
    for path in ("/live", LOOKS, "/metrics"):
        for headers in ({"Origin": "http://evil.example"}, {"Host": "evil.example"}):
            assert httpx.get(f"http://{address}{path}", headers=headers).status_code == 403, path
    offload.close()
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"http://{address}/metrics")


def test_connections_of_a_moment_wait_until_they_are_accepted() -> None:
    """While a port accepts nothing, 24 are made; one that is dropped would be tried again after seconds."""
    port = LivePort("127.0.0.1:0", "--port", source=RobotLive(dict))
    try:
        port._server.shutdown()
        address = ("127.0.0.1", port._server.server_port)
        opened = [socket.create_connection(address, timeout=5) for _ in range(24)]
        assert len(opened) == 24
        for one in opened:
            one.close()
    finally:
        port.close()
