"""Makes the arguments of a task smaller on their way to a server: by the `pack` of its kind, or compressed.

Which arguments are compressed is decided in `learning/packing.py`; `cloud` sends them.
"""

import threading
import time
from collections.abc import Callable
from typing import Any

from offboard.common.errors import BadValue, describe, is_interrupt
from offboard.common.tasks import Kind, Task
from offboard.common.wire.blobs import Buffer
from offboard.common.wire.compression import ZSTD, compress
from offboard.common.wire.payload import payload_bytes
from offboard.robot_client.sites.blob_uploads import InlineRule
from offboard.robot_client.sites.runner import Packed

PACK = "pack"


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

    def __init__(self, task: Task, inline: InlineRule, *, compresses: bool) -> None:
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
