"""When a robot sends its heartbeats, as the server sees it."""

import time
from collections.abc import Iterator
from concurrent import futures
from contextlib import closing, contextmanager, suppress
from types import NoneType

import pytest
import zmq

from offboard import Offloader, Settings
from offboard.common.tasks import Task, kind_of, kinds, task
from offboard.common.wire import messages as wire
from offboard.common.wire.messages import Hello, Message, Ping, Pong, Reply, Request
from offboard.robot_client.cloud.cloud_runner import CloudRunner
from offboard.robot_client.sites import conversation
from offboard.robot_client.sites.heartbeat import EVERY_S
from offboard.robot_client.sites.waiting import LINGER_S

pytestmark = pytest.mark.integration

WAIT_S = 8.0
HARDLY_EVER_S = 1000.0


@task("nothing_at_all", size=lambda: 0.0)
def nothing() -> None:
    pass


class Peer:
    """The server's end of the connection, played by the test."""

    def __init__(self, socket: "zmq.Socket[bytes]") -> None:
        self.endpoint = f"tcp://127.0.0.1:{socket.bind_to_random_port('tcp://127.0.0.1')}"
        self._socket = socket
        self._client = b""

    def hear(self, wait_s: float = WAIT_S) -> Message | None:
        if not self._socket.poll(round(wait_s * 1e3)):
            return None
        self._client, *frames = self._socket.recv_multipart()
        return wire.unpack(frames)

    def say(self, message: Message) -> None:
        self._socket.send_multipart([self._client, *wire.pack(message)])


@pytest.mark.parametrize(
    ("policy", "heartbeats", "beats"),
    [("paper", None, False), ("paper", True, True), ("default", None, True), ("default", False, False)],
)
def test_the_policy_or_the_settings_say_whether_there_are_heartbeats(
    policy: str, heartbeats: bool | None, beats: bool
) -> None:
    """With heartbeats, the first message after `hello` is a ping; without, there is none."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
        socket.linger = 0
        peer = Peer(socket)
        with Offloader.connect(peer.endpoint, policy=policy, settings=Settings(heartbeats=heartbeats)):
            assert isinstance(peer.hear(), Hello)
            peer.say(Hello({kind.name: kind.source_hash for kind in kinds()}, "0", 2**20))
            assert isinstance(peer.hear(WAIT_S if beats else 2 * EVERY_S), Ping if beats else NoneType)


@contextmanager
def met(heartbeat_s: float) -> Iterator[tuple[CloudRunner, Peer]]:
    """A robot whose first heartbeat was answered."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as socket:
        socket.linger = 0
        peer = Peer(socket)
        with closing(CloudRunner(peer.endpoint, heartbeat_s=heartbeat_s)) as runner:
            assert isinstance(peer.hear(), Hello)
            peer.say(Hello({kind.name: kind.source_hash for kind in kinds()}, "0", 2**20))
            first = peer.hear()
            assert isinstance(first, Ping)
            peer.say(Pong(first.id))
            yield runner, peer


def test_a_heartbeat_that_is_due_soon_is_sent_before_a_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its answer is read while the caller waits for the answer of the task."""
    monkeypatch.setattr(conversation, "EARLY_S", 2 * HARDLY_EVER_S)
    with met(HARDLY_EVER_S) as (runner, peer):
        answer = runner.submit(Task(kind_of(nothing), (), 0.0), WAIT_S)
        ping, request = peer.hear(), peer.hear()
        assert isinstance(ping, Ping)
        assert isinstance(request, Request)
        peer.say(Pong(ping.id, queue_depth=7))
        until_s = time.monotonic() + WAIT_S
        while runner.condition().queue != 7:
            assert time.monotonic() < until_s, "the answer to the heartbeat was not read"
            with suppress(futures.TimeoutError):
                answer.result(0.01)
        peer.say(Reply(request.id, "ok", body=wire.encode(None, (), blobs=False).frames))
        assert answer.result(WAIT_S).ok


def test_a_heartbeat_that_is_not_due_is_not_sent() -> None:
    """A task does not bring the next heartbeat forward."""
    with met(HARDLY_EVER_S) as (runner, peer):
        runner.submit(Task(kind_of(nothing), (), 0.0), WAIT_S)
        assert isinstance(peer.hear(), Request)
        assert peer.hear(2 * LINGER_S) is None
