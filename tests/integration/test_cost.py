"""What an empty task costs in messages and wake-ups; its time is measured by `make bench`."""

from collections import Counter
from threading import Thread

import pytest

from offboard.cloud_server.executors.thread_executor import ThreadExecutor
from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.server import Limits, Server
from offboard.common.tasks import task
from offboard.common.wire.channel import Channel
from offboard.robot_client.offloader import Offloader

pytestmark = pytest.mark.integration

TASKS = 300
WAIT_S = 8.0


@task("costs_nothing", size=lambda: 0.0)
def costs_nothing() -> None:
    pass


def test_an_empty_task_is_two_messages_and_wakes_no_other_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """The request and the reply are sent by the threads that make them, almost always without a wake-up.

    A reader is woken only if the answer comes before the send has ended."""
    counted: Counter[str] = Counter()
    send, wake = Channel.send, Channel.wake

    def counted_send(channel: Channel, frames: list[bytes]) -> None:
        counted["sent"] += 1
        send(channel, frames)

    def counted_wake(channel: Channel) -> None:
        counted["woken"] += 1
        wake(channel)

    monkeypatch.setattr(Channel, "send", counted_send)
    monkeypatch.setattr(Channel, "wake", counted_wake)
    server = Server(
        "tcp://127.0.0.1:0",
        ThreadExecutor(1),
        Metrics(),
        Limits(8, blob_bytes_max=2**20, message_bytes_max=2**20, robot_bytes_per_s=2**30, drain_s=1.0),
    )
    thread = Thread(target=server.run)
    thread.start()
    with Offloader.connect(server.endpoint, policy="cloud") as offload:
        assert not offload.wait_for_sites(costs_nothing, WAIT_S)
        counted.clear()
        for _ in range(TASKS):
            offload(costs_nothing)
        found = dict(counted)
    server.drain()
    thread.join(WAIT_S)
    assert found["sent"] == 2 * TASKS
    assert found.get("woken", 0) < 0.5 * TASKS
