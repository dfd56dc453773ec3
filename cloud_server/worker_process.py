"""What a worker process does: it runs one task after the other, within a limit of memory.

Its other end, in the server, is `workers`.
"""

import ctypes
import faulthandler
import mmap
import os
import resource
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack

from offboard.cloud_server.outcome import Outcome, run_task, warm_kinds
from offboard.common import tasks
from offboard.common.errors import describe
from offboard.common.wire.blobs import BlobStore, Buffer, StoredBlob
from offboard.common.wire.messages import ERROR_LENGTH_MAX, byte_count

CHUNK_BYTES = 1 << 16
ANSWER_BYTES_MAX = (1 << 31) - (1 << 20)  # no message is larger
PR_SET_PDEATHSIG = 1
# Made before it is needed: what the answer is where there is no memory for one.
NOTHING_LEFT: bytes = msgpack.packb(
    ["failed", "MemoryError: too little memory is left for an answer", 0.0, None, [], False, True]
)


def work(
    parent: int,
    pipe_fd: int,
    flag: int,
    modules: Sequence[str],
    folder: str,
    blob_bytes_max: int,
    memory_bytes_max: int,
) -> None:
    """What a worker process does: it tells that it is ready (""), then runs one task after the other."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the group; the server drains
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # the parent died before the line above
    for fd in (pipe_fd, flag):
        os.set_inheritable(fd, False)
    _limit_memory(memory_bytes_max)
    if sys.stderr is not None:
        faulthandler.enable()  # so that the server's log shows where a task crashed
    pipe, stop = socket.socket(fileno=pipe_fd), mmap.mmap(flag, 1)
    try:
        tasks.load_modules(modules)
        warm_kinds()
    except BaseException as error:  # noqa: BLE001 - a user's module may raise anything
        traceback.print_exc()
        pipe.sendall(msgpack.packb(describe(error), unicode_errors="replace"))
        return
    pipe.sendall(msgpack.packb(""))
    store = BlobStore(blob_bytes_max)
    while (call := _receive(pipe)) is not None:
        pipe.sendall(_answer(store, Path(folder), lambda: not stop[0], *call))
        del call  # its memory, while this waits for the next


def _limit_memory(bytes_max: int) -> None:
    """What can be written to and is its own counts; address space does not: threads reserve plenty of it."""
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    limit = bytes_max if most == resource.RLIM_INFINITY else min(bytes_max, most)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def _receive(pipe: socket.socket) -> Any | None:
    """The next message; None when the pipe is closed."""
    unpacker = new_unpacker()
    while data := pipe.recv(CHUNK_BYTES):
        unpacker.feed(data)
        for message in unpacker:
            return message
    return None


def _answer(
    store: BlobStore,
    folder: Path,
    wanted: Callable[[], bool],
    kind: str,
    frames: list[Buffer],
    digests: list[bytes],
) -> bytes:
    """The message about one task."""
    try:
        try:
            blobs = {digest: _blob(store, folder, digest) for digest in digests}
        except OSError as error:
            return _message(Outcome("failed", describe(error), server_fault=True))
        return _message(run_task(kind, frames, blobs, wanted))
    except MemoryError:
        return NOTHING_LEFT


def _blob(store: BlobStore, folder: Path, digest: bytes) -> StoredBlob:
    blob = store.get(digest)
    if blob is None:
        store.add((folder / digest.hex()).read_bytes())
        blob = store.get(digest)
    assert blob is not None, "a blob larger than the store passed the server"
    return blob


def _message(outcome: Outcome) -> bytes:
    size = byte_count(outcome.frames)
    if size > ANSWER_BYTES_MAX:
        error = f"BadValue: the result takes {size} bytes, at most {ANSWER_BYTES_MAX} are allowed"
        outcome = replace(outcome, status="failed", error=error, frames=[])
    error, full = outcome.error[:ERROR_LENGTH_MAX], _full(outcome.error)
    fields = [outcome.status, error, outcome.run_s, outcome.cpu_s, outcome.frames, outcome.server_fault]
    message: bytes = msgpack.packb([*fields, full], unicode_errors="replace")
    return message


def _full(error: str) -> bool:
    """Whether memory ran out, and half of it is still taken: the next task would find too little."""
    if not error.partition(":")[0].endswith("MemoryError"):
        return False
    pages = int(Path("/proc/self/statm").read_text().split()[5])
    return pages * resource.getpagesize() > resource.getrlimit(resource.RLIMIT_DATA)[0] / 2


def new_unpacker() -> Any:
    """For one message: an unpacker keeps the memory of the largest that it had."""
    return msgpack.Unpacker(max_buffer_size=0)
