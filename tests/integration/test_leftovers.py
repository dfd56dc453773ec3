"""Offloaders that were closed, or could not connect, leave no thread, socket or file behind."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import OffloadError
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD
from tests.leftovers import left, left_for_good
from tests.probes import echo, nap

pytestmark = [pytest.mark.integration, pytest.mark.timeout(240)]

CYCLES = 50
TIMEOUT_S = 0.2
SETTLED_S = 5.0  # for a thread that has just ended, on a busy machine


def check_nothing_left(cycle: Callable[[int], None]) -> None:
    """Run the cycle once to load what stays loaded, then CYCLES times, and compare."""
    cycle(-1)
    before = left_for_good()
    for number in range(CYCLES):
        cycle(number)
    end_s = time.monotonic() + SETTLED_S
    while left() != before and time.monotonic() < end_s:
        time.sleep(0.05)
    assert left() == before, f"threads and files {left()}, before {before}; {threading.enumerate()}"


def open_and_close(endpoint: str) -> None:
    with Offloader.connect(endpoint, policy=CLOUD, timeout_s=TIMEOUT_S) as offload:
        assert offload(echo, 1) == 1


def close_during_a_task(endpoint: str) -> None:
    """The caller gets the answer, or the error that the offloader was closed."""
    offload = Offloader.connect(endpoint, policy=CLOUD, timeout_s=TIMEOUT_S)
    offload.wait_for_sites(nap, TIMEOUT_S)
    ended = threading.Event()

    def call() -> None:
        with contextlib.suppress(OffloadError):
            offload(nap, 0.05)
        ended.set()

    threading.Thread(target=call).start()
    time.sleep(0.01)
    offload.close()
    assert ended.wait(SETTLED_S), "a caller hangs"


@pytest.fixture
def swallowing() -> Iterator[str]:
    """The endpoint of a listener whose queue is full: the kernel drops what comes, as a bad network does."""
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
        for _ in range(4):
            client = stack.enter_context(socket.socket())
            client.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                client.connect(listener.getsockname())
        yield f"tcp://127.0.0.1:{listener.getsockname()[1]}"


@pytest.mark.parametrize("use", [open_and_close, close_during_a_task])
def test_nothing_is_left_of_a_living_server(
    testbed: Callable[..., LocalTestbed], use: Callable[[str], None]
) -> None:
    """The server answers, and the offloader is closed after a task or during one."""
    bed = testbed()
    check_nothing_left(lambda _: use(bed.endpoint))


def test_nothing_is_left_of_a_dead_server() -> None:
    """Nothing listens on the port."""
    with socket.create_server(("127.0.0.1", 0)) as unused:
        port = unused.getsockname()[1]
    check_nothing_left(lambda _: open_and_close(f"tcp://127.0.0.1:{port}"))
    check_nothing_left(lambda _: open_and_close(f"tcp://localhost:{port}"))


def test_nothing_is_left_of_a_server_behind_a_silent_network(swallowing: str) -> None:
    """Each attempt to connect is still going on when the offloader is closed."""
    check_nothing_left(lambda _: open_and_close(swallowing))


def test_nothing_is_left_of_a_server_that_is_killed(testbed: Callable[..., LocalTestbed]) -> None:
    """The server is killed and started again several times, and stopped where it is."""
    bed = testbed()
    events: dict[int, Callable[[str], Any]] = {10: bed.kill, 20: bed.start, 30: bed.pause, 40: bed.resume}

    def cycle(number: int) -> None:
        happens = events.get(number, lambda _: None)
        offload = Offloader.connect(bed.endpoint, policy=CLOUD, timeout_s=TIMEOUT_S)
        offload.wait_for_sites(echo, TIMEOUT_S)
        happens("cloud")
        with offload:
            assert offload(echo, 1) == 1

    check_nothing_left(cycle)


def wrong(folder: Path, taken: str) -> Iterator[dict[str, Any]]:
    """Arguments with which `connect` fails, each at another step."""
    right = "tcp://127.0.0.1:9"
    yield {"endpoint": "tcp://127.0.0.1"}
    yield {"endpoint": "tcp://..:9"}
    yield {"endpoint": right, "sites": {"near": right, "far": "udp://127.0.0.1:9"}}
    yield {"endpoint": right, "keys": folder / "none"}
    yield {"endpoint": right, "policy": "none"}
    yield {"endpoint": right, "timeout_s": -1.0}
    yield {"endpoint": right, "trace": folder}
    yield {"endpoint": right, "trace": folder / "trace.jsonl", "metrics": taken}
    yield {"endpoint": right, "trace": folder / "trace.jsonl", "timeout_s": -1.0}
    yield {"endpoint": right, "settings": Settings(memory=folder)}


def test_nothing_is_left_of_a_connect_that_fails(tmp_path: Path) -> None:
    """Whatever is wrong, all that was opened before is closed."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        arguments = list(wrong(tmp_path, f"127.0.0.1:{taken.getsockname()[1]}"))

        def cycle(_: int) -> None:
            for one in arguments:
                with pytest.raises(OffloadError):
                    raise AssertionError(f"{Offloader.connect(**one)} of {one}")

        check_nothing_left(cycle)
