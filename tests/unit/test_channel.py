"""A socket that one thread reads and any thread sends on: nothing waits that is there."""

import threading
import time
from collections.abc import Iterator

import pytest
import zmq

from offboard.common.wire.channel import Channel

SENDERS, MESSAGES = 4, 500
LONG_S = 30.0  # a signal that is lost is one that a test waits for as long


@pytest.fixture
def pair() -> "Iterator[tuple[zmq.Socket[bytes], Channel, zmq.Socket[bytes]]]":
    """A channel on a DEALER, and the ROUTER that it is connected to."""
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
    """Answers that arrive while other threads send are all read at once, never at the next timeout."""
    _, channel, router = pair

    def echo() -> None:
        for _ in range(SENDERS * MESSAGES):
            router.send_multipart(router.recv_multipart())

    def send(name: int) -> None:
        for n in range(MESSAGES):
            channel.send([f"{name} {n}".encode()])
            while n - heard[name] > 2:  # about as many are under way as answers come
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


def test_a_wake_is_kept_for_a_reader_that_does_not_wait_yet(
    pair: "tuple[zmq.Socket[bytes], Channel, zmq.Socket[bytes]]",
) -> None:
    """`wake` ends the wait that is under way, else the next one; after it there is nothing to read."""
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


def test_a_full_queue_is_an_error_and_no_wait(
    pair: "tuple[zmq.Socket[bytes], Channel, zmq.Socket[bytes]]",
) -> None:
    """What cannot be sent now is zmq.Again."""
    dealer, channel, router = pair
    address = router.last_endpoint
    dealer.disconnect(address)
    with pytest.raises(zmq.Again):
        channel.send([b"nobody takes it"])


class Interrupted:
    """The socket, but Ctrl-C comes before the second frame is read."""

    def __init__(self, socket: "zmq.Socket[bytes]") -> None:
        self._socket = socket
        self._left = 1

    def getsockopt(self, option: int) -> int | bytes:
        return self._socket.getsockopt(option)

    def recv(self, flags: int, *, copy: bool) -> bytes | zmq.Frame:
        if self._left == 0:
            self._left = 100
            raise KeyboardInterrupt
        self._left -= 1
        return self._socket.recv(flags, copy=copy)


def test_a_message_whose_reading_is_interrupted_is_read_on(
    pair: "tuple[zmq.Socket[bytes], Channel, zmq.Socket[bytes]]", monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever reads next gets all of its frames, and the next message after it."""
    dealer, channel, router = pair
    channel.send([b"hello"])
    robot = router.recv_multipart()[0]
    for first in (b"a", b"d"):
        router.send_multipart([robot, first, b"b", b"c"])
    channel.wait(LONG_S)
    monkeypatch.setattr(channel, "_socket", Interrupted(dealer))
    with pytest.raises(KeyboardInterrupt):
        channel.receive()
    for first in (b"a", b"d"):
        channel.wait(LONG_S)
        message = channel.receive()
        assert message is not None
        assert [frame.bytes for frame in message] == [first, b"b", b"c"]
