"""What runs in a worker process: one task after the other. `worker` is the other end of the pipe."""

import ctypes
import faulthandler
import math
import mmap
import os
import resource
import signal
import socket
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgpack

from offboard.cloud_server.executors.executor import Call, Outcome, bounded, run_task, warm_kinds
from offboard.cloud_server.executors.joint_run import run_joint
from offboard.common.errors import TaskFailed, describe
from offboard.common.source.task_modules import load_modules
from offboard.common.task_states import TaskStates
from offboard.common.wire.blobs import BlobStore, StoredBlob

CHUNK_BYTES = 1 << 16
FIELDS = 8  # of an outcome in a message; more of them if several requests ran in one call
ANSWER_BYTES_MAX = (1 << 31) - (1 << 20)  # no message is larger
PR_SET_PDEATHSIG = 1
# Ctrl-C, and some service managers, reach all processes of the server.
STOPS = (signal.SIGINT, signal.SIGTERM)
# Prepared in advance, for the case that no memory is left to build an answer.
NOTHING_LEFT: bytes = msgpack.packb(
    ["failed", "MemoryError: too little memory is left for an answer", 0.0, None, [], True, False, "", True]
)


@dataclass(frozen=True, slots=True)
class Setup:
    """The settings of a worker process. `folder` holds the blobs as files."""

    modules: tuple[str, ...]
    folder: str
    blob_bytes_max: int
    memory_bytes_max: int


def work(parent: int, pipe_fd: int, flag: int, setup: Setup) -> None:
    """Run a worker process: load the modules, then run the tasks that come through the pipe.

    Its first message says why it cannot start, and with which traceback; both are empty if it is ready.
    """
    outlive_stops()
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # the parent died before the line above
    for fd in (pipe_fd, flag):
        os.set_inheritable(fd, False)
    limit_memory(setup.memory_bytes_max)
    if sys.stderr is not None:
        faulthandler.enable()  # the server's log then shows where a task crashed
    pipe, stop = socket.socket(fileno=pipe_fd), mmap.mmap(flag, 1)
    states = TaskStates(workers=1)
    try:
        load_modules(setup.modules)
        warm_kinds(states)
    except TaskFailed as failure:
        pipe.sendall(msgpack.packb([str(failure), failure.traceback], unicode_errors="replace"))
        return
    except BaseException as error:  # noqa: BLE001 - a user's module may raise anything
        traceback.print_exc()
        pipe.sendall(msgpack.packb([describe(error), ""], unicode_errors="replace"))
        return
    pipe.sendall(msgpack.packb(["", ""]))
    store = BlobStore(setup.blob_bytes_max)
    while (call := _receive(pipe)) is not None:
        pipe.sendall(_answer(call, store, Path(setup.folder), wanted=lambda: not stop[0], states=states))
        del call  # free its memory before the next one comes


def outlive_stops() -> None:
    """End with the pipe and not by STOPS, which the server has blocked: its drain still needs this worker.

    They are not ignored, as programs that a task starts would then ignore them too.
    """
    for number in STOPS:
        signal.signal(number, lambda *_: None)
        os.register_at_fork(after_in_child=partial(signal.signal, number, signal.SIG_DFL))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)


def limit_memory(bytes_max: int) -> None:
    """Limit the private, writable memory. The address space does not count: threads only reserve it."""
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    limit = bytes_max if most == resource.RLIM_INFINITY else min(bytes_max, most)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def _receive(pipe: socket.socket) -> Any | None:
    unpacker = new_unpacker()
    while data := pipe.recv(CHUNK_BYTES):
        unpacker.feed(data)
        for message in unpacker:
            return message
    return None


def _answer(
    message: list[Any],
    store: BlobStore,
    folder: Path,
    *,
    wanted: Callable[[], bool],
    states: TaskStates,
) -> bytes:
    """Run one task; returns the message about its outcome."""
    kind, frames, digests, *joint = message
    try:
        try:
            calls = [
                Call(kind, one, _blobs(store, folder, named), wanted, budget_s=budget_s)
                for one, named, budget_s in ([frames, digests, math.inf], *joint)
            ]
        except OSError as error:
            return _message(Outcome("failed", describe(error), server_fault=True))
        if joint:
            return _message(run_joint(replace(calls[0], more=tuple(calls[1:])), states))
        return _message(run_task(calls[0], states))
    except MemoryError:
        return NOTHING_LEFT


def _blobs(store: BlobStore, folder: Path, digests: list[bytes]) -> dict[bytes, StoredBlob]:
    return {digest: _blob(store, folder, digest) for digest in digests}


def _blob(store: BlobStore, folder: Path, digest: bytes) -> StoredBlob:
    blob = store.get(digest)
    if blob is None:
        store.add((folder / digest.hex()).read_bytes())
        blob = store.get(digest)
    assert blob is not None, "the server passed on a blob larger than the store"
    return blob


def packed(call: Call) -> list[Any]:
    """The message for a call: its kind, frames and digests; then those of each call that runs with it."""
    message = [call.kind, list(call.frames), list(call.blobs)]
    return message + [[list(one.frames), list(one.blobs), one.budget_s] for one in call.more]


def outcome_of(fields: list[Any]) -> Outcome:
    """The outcome in a message, without its last field."""
    outcome = Outcome(*fields[:FIELDS])
    if len(fields) > FIELDS:
        outcome.together, outcome.queue_s, outcome.note, *more = fields[FIELDS:]
        outcome.more = [outcome_of(one) for one in more]
    return outcome


def _message(outcome: Outcome) -> bytes:
    kept = full(outcome.error)
    each_max = ANSWER_BYTES_MAX // (1 + len(outcome.more))
    message: bytes = msgpack.packb([*_fields(outcome, each_max), kept], unicode_errors="replace")
    return message


def _fields(outcome: Outcome, bytes_max: int) -> list[Any]:
    outcome = bounded(outcome, bytes_max)
    fields = [outcome.status, outcome.error, outcome.run_s, outcome.cpu_s, outcome.frames]
    fields += [outcome.server_fault, outcome.crashed, outcome.traceback]
    if outcome.more or outcome.together > 1 or outcome.queue_s:
        fields += [outcome.together, outcome.queue_s, outcome.note]
        fields += [_fields(one, bytes_max) for one in outcome.more]
    return fields


def full(error: str) -> bool:
    """True if the task ran out of memory and half is still in use: the next task would have too little."""
    if not error.partition(":")[0].endswith("MemoryError"):
        return False
    pages = int(Path("/proc/self/statm").read_text().split()[5])
    return pages * resource.getpagesize() > resource.getrlimit(resource.RLIMIT_DATA)[0] / 2


def new_unpacker() -> Any:
    """An unpacker for one message. It would keep the memory of the largest message that it has seen."""
    return msgpack.Unpacker(max_buffer_size=0)
