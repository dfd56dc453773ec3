"""A ZMQ socket that one thread reads and any thread sends on.

A socket may be used by several threads, one after the other, where a lock is between them. The reader must
then not wait inside the socket: it waits for the descriptor by which libzmq signals.
"""

import contextlib
import select
import socket
import threading
from collections.abc import Sequence
from typing import Any

import zmq

COPIED_BYTES_MAX = 4096  # of a frame that is copied into the message
WAKE_BYTES = 4096  # taken at once of the pair by which the reader is woken
# As whole numbers: pyzmq's flags make a new object at each `|` and `&`, which takes longer than the call.
_NOW, _MORE = int(zmq.DONTWAIT), int(zmq.DONTWAIT | zmq.SNDMORE)
_POLLIN = int(zmq.POLLIN)


class Channel:
    """`lock` is held while the socket is used; whoever needs more to be of one piece may hold it longer.

    `watched`: further descriptors for which `wait` returns. The owner closes the socket.
    """

    def __init__(self, of: "zmq.Socket[bytes]", *watched: int) -> None:
        self.lock = threading.RLock()
        self._socket = of
        self._frames: list[zmq.Frame] = []  # of a message whose reading was interrupted, as by Ctrl-C
        self._read_out = False  # nothing was left to read; for what comes after that there is a signal
        self._waker, self._woken = socket.socketpair()
        self._waker.setblocking(False)
        self._woken.setblocking(False)
        self._poll = select.poll()
        for readable in (of.FD, self._woken.fileno(), *watched):
            self._poll.register(readable, select.POLLIN)

    def send(self, frames: Sequence[Any]) -> None:
        """Never waits: zmq.Again where the queue is full."""
        with self.lock:
            *first, last = frames
            for frame in first:
                self._send(frame, _MORE)
            self._send(last, _NOW)
            # The signal is given once, for all that happened before: sending may have taken it.
            if readable(self._socket):
                self.wake()

    def receive(self) -> "list[zmq.Frame] | None":
        """The next message; None where there is none. For the reader."""
        with self.lock:
            if not readable(self._socket):
                self._read_out = True
                return None
            self._read_out = False
            frames = self._frames
            with contextlib.suppress(zmq.Again):
                while not frames or frames[-1].more:
                    frames.append(self._socket.recv(_NOW, copy=False))
            self._frames = []
            return frames or None

    def wait(self, timeout_s: float) -> None:
        """Until there is something to read, or `wake` was called. For the reader."""
        if not self._read_out:
            with self.lock:
                if readable(self._socket):
                    return
        self._read_out = False
        ready = self._poll.poll(max(0.0, timeout_s) * 1e3)
        if any(descriptor == self._woken.fileno() for descriptor, _ in ready):
            self._woken.recv(WAKE_BYTES)

    def wake(self) -> None:
        """Make `wait` return, the next one if none is under way. Any thread, any time."""
        with contextlib.suppress(OSError):  # full: it is awake already; closed: there is nobody to wake
            self._waker.send(b"\0")

    def close(self) -> None:
        """What `wake` needs; not the socket."""
        self._waker.close()
        self._woken.close()

    def _send(self, frame: Any, flags: int) -> None:
        # Copying a small frame costs less than what lets the sender go on owning it.
        copied = isinstance(frame, bytes) and len(frame) <= COPIED_BYTES_MAX
        self._socket.send(frame, flags, copy=copied)


def readable(of: "zmq.Socket[bytes]") -> bool:
    """Whether there is a message."""
    return bool(int(of.getsockopt(zmq.EVENTS)) & _POLLIN)
