"""What of a task's arguments goes to a server: packed by their kind, compressed, in the request or by digest.

An argument that goes by digest is a blob: the server asks for its bytes only if it does not have them. That
saves sending the same bytes twice, and costs a hash on both sides and, for new bytes, a message of its own.
Images and scans are new every time, so they are better sent inside the request.
Which arguments are compressed is decided in `learning/packing.py`; `cloud` sends them.
"""

import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import Any

from offboard.common.errors import BadValue, describe, is_interrupt
from offboard.common.tasks import Kind, Task
from offboard.common.wire.blobs import Buffer
from offboard.common.wire.compression import ZSTD, compress
from offboard.common.wire.messages import Body
from offboard.common.wire.payload import payload_bytes
from offboard.robot_client.sites.runner import Packed

PACK = "pack"
KEPT = 1024  # digests, and samples, that are remembered
NEW_AFTER = 2  # tasks of a kind in a row that had a new argument, before new arguments go inside the request
SAMPLE_BYTES = 64  # taken of an argument to recognise it; two arguments with equal samples may still differ
INLINE_BYTES_MAX = 16 * 1024 * 1024  # of the arguments of one task
INLINE_SHARE = 0.5  # of the largest message that the server takes, for the same


class Parcel:
    """The packed arguments of one task, made when a site first needs them. Any thread may call `packed`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._made: list[Any] = []  # what `pack` returned, once it has

    def packed(self, kind: Kind, args: tuple[Any, ...]) -> tuple[Any, float]:
        """What `pack` returns, and the seconds that it took: 0 if another site has needed it before.

        BadValue if `pack` raises.
        """
        assert kind.pack is not None
        with self._lock:
            if self._made:
                return self._made[0], 0.0
            began_s = time.perf_counter()
            try:
                self._made.append(kind.pack(*args))
            except BaseException as error:  # the function is the user's own
                if is_interrupt(error):
                    raise
                raise BadValue(f"pack of task {kind.name}: {describe(error)}") from error
            return self._made[0], time.perf_counter() - began_s


class Outgoing:
    """What one run sends. It is called with each large array, and returns the frame for it.

    `inline`: says which arrays go inside the request; for the others, which are blobs, it returns None.
    `packed`: what was packed so far, and what that took.
    """

    packed: tuple[Packed, ...] = ()

    def __init__(self, task: Task, inline: "InlineRule", *, compresses: bool) -> None:
        self.inline = inline
        self._compress = task.compress if compresses else ()

    def __call__(self, argument: int, raw: memoryview) -> Buffer | None:
        return self.smaller(argument, raw) if self.inline(raw) else None

    def values(self, task: Task, known: Callable[[memoryview], bool]) -> list[Any]:
        """The arguments, or the one value that the kind packs them into; `known` is for large parts of it."""
        if task.kind.pack is None:
            return list(task.args)
        value, seconds = (task.parcel or Parcel()).packed(task.kind, task.args)
        before, after = payload_bytes(task.args), payload_bytes(value, known)
        self.packed += (Packed(None, PACK, before, bytes=after, seconds=seconds),)
        return [value]

    def smaller(self, argument: int, raw: memoryview) -> Buffer:
        """The compressed bytes of an array of this argument, or the bytes themselves."""
        if argument not in self._compress:
            return raw
        began_s = time.perf_counter()
        found = compress(raw)
        smallest: Buffer = found if len(found) < raw.nbytes else raw
        seconds, after = time.perf_counter() - began_s, min(len(found), raw.nbytes)
        self.packed += (Packed(argument, ZSTD, raw.nbytes, bytes=after, seconds=seconds),)
        return smallest


def new_task(kind: Kind, args: tuple[Any, ...]) -> Task:
    """A call of this kind, whose arguments are packed at most once. BadValue if its size is none."""
    return Task(kind, args, kind.size_of(args), parcel=None if kind.pack is None else Parcel())


class BlobUploads:
    """Remembers what one connection has carried, and so what goes inside a request. See `InlineRule`.

    Only `inline_rule` may be called without a lock.
    """

    def __init__(self) -> None:
        self._last_message: OrderedDict[bytes, int] = OrderedDict()  # the number of it, by digest
        self._new_in_a_row: Counter[str] = Counter()  # tasks with a new argument, by kind
        self._samples: OrderedDict[bytes, None] = OrderedDict()

    def forget(self) -> None:
        """The connection has ended, and the next one may lead to another server."""
        self._last_message.clear()

    def unknown(self, body: Body) -> list[bytes]:
        """The digests of `body` that this connection has not carried."""
        return [digest for digest in body.blobs if digest not in self._last_message]

    def sent(self, digest: bytes, message: int) -> None:
        """The message of this number carried the blob."""
        self._last_message[digest] = message
        if len(self._last_message) > KEPT:
            self._last_message.popitem(last=False)

    def carried_after(self, digest: bytes, message: int) -> bool:
        """Whether a message after the one of this number carried the blob."""
        return self._last_message.get(digest, 0) > message

    def probably_carried(self, raw: memoryview) -> bool:
        """Whether an argument like this one was sent before: its length and some of its bytes are equal."""
        return _sample(raw) in self._samples

    def often_new(self, kind: str) -> bool:
        return self._new_in_a_row[kind] >= NEW_AFTER

    def found(self, kind: str, *, new: bool) -> None:
        """Note whether the server lacked a blob of a task of this kind."""
        self._new_in_a_row[kind] = self._new_in_a_row[kind] + 1 if new else 0

    def inline_rule(self, kind: str, message_bytes_max: int) -> "InlineRule":
        """The rule for the arguments of one task of this kind."""
        bytes_max = min(INLINE_BYTES_MAX, INLINE_SHARE * message_bytes_max)
        return InlineRule(self._samples, bytes_max if self.often_new(kind) else 0)


class InlineRule:
    """Called with each large argument of one task: says whether its bytes go inside the request.

    They do if the argument is certainly new, and all such arguments together have at most `bytes_max` bytes.
    """

    def __init__(self, samples: "OrderedDict[bytes, None]", bytes_max: float) -> None:
        self._samples = samples
        self._bytes_max = bytes_max
        self._bytes = 0

    def __call__(self, raw: memoryview) -> bool:
        sample = _sample(raw)
        new = sample not in self._samples
        self._samples[sample] = None
        self._samples.move_to_end(sample)
        if len(self._samples) > KEPT:
            self._samples.popitem(last=False)
        if not new or self._bytes + raw.nbytes > self._bytes_max:
            return False
        self._bytes += raw.nbytes
        return True

    @property
    def used(self) -> bool:
        return self._bytes > 0


def _sample(raw: memoryview) -> bytes:
    """The length of an argument and a few of its bytes."""
    # The step is odd, so that in numbers of 8 bytes each byte has its turn.
    step = raw.nbytes // SAMPLE_BYTES | 1
    return b"%d:%b" % (raw.nbytes, raw[::step].tobytes())
