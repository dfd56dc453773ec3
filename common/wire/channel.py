"""A ZMQ socket that one thread reads and any thread sends on, and the context that it is made in.

Several threads may use a ZMQ socket if a lock lets only one of them in at a time. The reader must then not
wait inside the socket; it waits for the file descriptor on which libzmq signals. A look at the socket takes a
system call, so it is left out where its answer is known. `messages` says what the frames mean.
"""

import contextlib
import os
import select
import socket
import threading
from collections.abc import Sequence
from typing import Any

import zmq

from offboard.common.errors import OffloadError

FILES, THREADS = 24, 8  # that a first context with its sockets needs, with some to spare
COPIED_BYTES_MAX = 4096  # a larger frame is not copied into the message
WAKE_BYTES = 4096  # wake-ups read at once
# As integers: with pyzmq's flags, each `|` and `&` makes a new object, which takes longer than the call.
_NOW, _MORE = int(zmq.DONTWAIT), int(zmq.DONTWAIT | zmq.SNDMORE)
_POLLIN = int(zmq.POLLIN)


class Channel:
    """A socket with a lock. Hold `lock` around several calls that must not be interrupted by other threads.

    `wait` also returns for the file descriptors `watched`. The owner closes the socket.

    watched_ready: whether one of `watched` may have been readable since somebody set this to False.
    """

    def __init__(self, of: "zmq.Socket[bytes]", *watched: int) -> None:
        self.lock = threading.RLock()
        self._socket = of
        self._frames: list[zmq.Frame] = []  # frames of a message whose reading was interrupted by Ctrl-C
        self._read_out = False  # all was read; libzmq signals the next message
        self._signalled = False  # libzmq did, and nothing was read since
        self._waits = False  # the reader waits, or is about to
        self.watched_ready = True
        self._waker, self._woken = socket.socketpair()
        self._waker.setblocking(False)
        self._woken.setblocking(False)
        self._poll = select.poll()
        self._signal, self._wakes = int(of.FD), self._woken.fileno()
        for file in (self._signal, self._wakes, *watched):
            self._poll.register(file, select.POLLIN)

    def send(self, frames: Sequence[Any]) -> None:
        """Send without waiting; zmq.Again if the queue is full."""
        with self.lock:
            # libzmq signals only once for everything that happened, and sending may use up the signal.
            # A reader that does not wait yet looks before it does.
            self._read_out = False
            *first, last = frames
            for frame in first:
                self._send(frame, _MORE)
            self._send(last, _NOW)
            if self._waits and readable(self._socket):
                self.wake()

    def receive(self) -> "list[zmq.Frame] | None":
        """The next message; None if there is none. For the reader."""
        with self.lock:
            if not (self._signalled or readable(self._socket)):
                self._read_out = True
                return None
            self._signalled = self._read_out = False
            frames = self._frames
            with contextlib.suppress(zmq.Again):
                while not frames or frames[-1].more:
                    frames.append(self._socket.recv(_NOW, copy=False))
            self._frames = []
            return frames or None

    def wait(self, timeout_s: float) -> None:
        """Wait until there is a message or `wake` is called. For the reader."""
        self._waits = True  # before looking: a thread that sends from now on wakes this one
        if not self._read_out:
            with self.lock:
                if readable(self._socket):
                    self._waits, self._signalled = False, True
                    return
        ready = self._poll.poll(max(0.0, timeout_s) * 1e3)
        self._waits = self._read_out = False
        for file, _ in ready:
            if file == self._signal:
                self._signalled = True
            elif file == self._wakes:
                self._woken.recv(WAKE_BYTES)
            else:
                self.watched_ready = True

    def wake(self) -> None:
        """End the current `wait`, or else the next one. Any thread may call this at any time."""
        with contextlib.suppress(OSError):  # full: the reader is awake already; closed: there is none
            self._waker.send(b"\0")

    def close(self) -> None:
        """Close the pair of sockets behind `wake`, but not the socket itself."""
        self._waker.close()
        self._woken.close()

    def _send(self, frame: Any, flags: int) -> None:
        # Copying a small frame costs less than tracking when libzmq no longer needs it.
        copied = isinstance(frame, bytes) and len(frame) <= COPIED_BYTES_MAX
        self._socket.send(frame, flags, copy=copied)


def make_context(where: str) -> "zmq.Context[zmq.Socket[bytes]]":
    """A context; OffloadError if this process lacks files or threads. `where` names the flag or the field.

    libzmq ends the process if it lacks one while a context is made.
    """
    check_room(where)
    zmq.Frame(bytes(zmq.COPY_THRESHOLD))  # pyzmq makes a context for large messages: now, as there is room
    return zmq.Context()


def check_room(where: str) -> None:
    """OffloadError if this process lacks files or threads for a connection."""
    pipes: list[int] = []
    over = threading.Event()
    threads = [threading.Thread(target=over.wait, daemon=True) for _ in range(THREADS)]
    try:
        while len(pipes) < FILES:
            pipes += os.pipe()
        for thread in threads:
            thread.start()
    except OSError as error:
        why = f"a connection needs {FILES} files, and this process may open {len(pipes)} more"
        raise OffloadError(f"{where}: {why}; close some, or raise the limit (ulimit -n)") from error
    except RuntimeError as error:
        why = f"a connection needs {THREADS} threads, and this process may not start that many"
        raise OffloadError(f"{where}: {why}; end some, or raise the limit (ulimit -u)") from error
    finally:
        over.set()
        for thread in threads:
            if thread.ident is not None:
                thread.join()
        for file in pipes:
            os.close(file)


def readable(of: "zmq.Socket[bytes]") -> bool:
    return bool(int(of.getsockopt(zmq.EVENTS)) & _POLLIN)
