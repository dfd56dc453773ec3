"""A socket that one thread reads and any thread sends on."""

import threading
import time
from collections.abc import Iterator

import pytest
import zmq

from offboard.common.wire.channel import Channel

pytestmark = pytest.mark.integration

SENDERS, MESSAGES = 4, 500
LONG_S = 30.0  # a test that lost a signal waits for this long


@pytest.fixture
def pair() -> "Iterator[tuple[zmq.Socket[bytes], Channel, zmq.Socket[bytes]]]":
    """A DEALER, a channel on it, and the ROUTER that it is connected to."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    dealer, router = context.socket(zmq.DEALER), context.socket(zmq.ROUTER)
    dealer.connect(f"tcp://127.0.0.1:{router.bind_to_random_port('tcp://127.0.0.1')}")
    channel = Channel(dealer)
    yield dealer, channel, router
    channel.close()
    context.destroy(linger=0)


def test_no_signal_is_lost_between_senders_and_reader(
    pair: "tuple[zmq.Socket[bytes], Channel, zmq.Socket[bytes]]",
) -> None:
    """Answers that arrive while other threads send are read at once, not after the timeout."""
    _, channel, router = pair

    def echo() -> None:
        for _ in range(SENDERS * MESSAGES):
            router.send_multipart(router.recv_multipart())

    def send(name: int) -> None:
        for n in range(MESSAGES):
            channel.send([f"{name} {n}".encode()])
            while n - heard[name] > 2:  # keep a few messages in flight
                time.sleep(0)

    heard = [-1] * SENDERS
    threads = [threading.Thread(target=echo, daemon=True)]
    threads += [threading.Thread(target=send, args=(name,), daemon=True) for name in range(SENDERS)]
    for thread in threads:
        thread.start()
    left, waits = SENDERS * MESSAGES, []
    while left:
        began = time.monotonic()
        channel.wait(LONG_S)
        waits.append(time.monotonic() - began)
        while (message := channel.receive()) is not None:
            name, n = map(int, message[0].bytes.split())
            assert n == heard[name] + 1
            heard[name] = n
            left -= 1
    for thread in threads:
        thread.join()
    assert max(waits) < LONG_S


def test_a_wake_is_kept_for_the_next_wait(
    pair: "tuple[zmq.Socket[bytes], Channel, zmq.Socket[bytes]]",
) -> None:
    """`wake` ends the current wait, or else the next one; it leaves nothing to read."""
    _, channel, _ = pair
    channel.wake()
    channel.wait(LONG_S)
    thread = threading.Thread(target=channel.wait, args=(LONG_S,))
    began = time.monotonic()
    thread.start()
    channel.wake()
    thread.join()
    assert time.monotonic() - began < LONG_S
    assert channel.receive() is None


def test_a_full_queue_is_an_error(
    pair: "tuple[zmq.Socket[bytes], Channel, zmq.Socket[bytes]]",
) -> None:
    """If a message cannot be sent now, `send` raises zmq.Again instead of waiting."""
    dealer, channel, router = pair
    address = router.last_endpoint
    dealer.disconnect(address)
    with pytest.raises(zmq.Again):
        channel.send([b"nobody takes it"])


class Interrupted:
    """A socket on which Ctrl-C comes before the second frame is read."""

    def __init__(self, socket: "zmq.Socket[bytes]") -> None:
        self._socket = socket
        self._left = 1
        self.FD = socket.FD

    def getsockopt(self, option: int) -> int | bytes:
        return self._socket.getsockopt(option)

    def send(self, frame: bytes, flags: int, *, copy: bool) -> None:
        self._socket.send(frame, flags, copy=copy)

    def recv(self, flags: int, *, copy: bool) -> bytes | zmq.Frame:
        if self._left == 0:
            self._left = 100
            raise KeyboardInterrupt
        self._left -= 1
        return self._socket.recv(flags, copy=copy)


def test_an_interrupted_message_is_not_lost(
    pair: "tuple[zmq.Socket[bytes], Channel, zmq.Socket[bytes]]",
) -> None:
    """The next call of `receive` returns all of its frames, and the one after that the next message."""
    dealer, _, router = pair
    channel = Channel(Interrupted(dealer))  # type: ignore[arg-type]
    channel.send([b"hello"])
    robot = router.recv_multipart()[0]
    for first in (b"a", b"d"):
        router.send_multipart([robot, first, b"b", b"c"])
    channel.wait(LONG_S)
    with pytest.raises(KeyboardInterrupt):
        channel.receive()
    for first in (b"a", b"d"):
        channel.wait(LONG_S)
        message = channel.receive()
        assert message is not None
        assert [frame.bytes for frame in message] == [first, b"b", b"c"]
    channel.close()
