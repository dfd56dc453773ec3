"""The messages of attackers: changed copies of valid messages, and small messages that claim to be large.

Who sends them, and how, is in `attackers.py`.
"""

import pickle
import random
from typing import Any

import msgpack
import numpy as np

from offboard.common.planning.maps import GridMap
from offboard.common.planning.planner import Point, Pose, Scan, plan_path
from offboard.common.tasks import kind_of
from offboard.common.wire import messages as wire
from offboard.common.wire.compression import compress

EXT_BLOB, EXT_DATACLASS, EXT_COMPRESSED = 2, 3, 4  # msgpack extensions of offboard.common.wire.values

Frames = list[Any]


def valid_messages() -> list[Frames]:
    """One message of each type; the plans have all arguments that a plan can have."""
    kind = kind_of(plan_path)
    cells = np.zeros((20, 30), np.int8)
    scan = Scan(np.full(8, 2.5, np.float32), 0.0, 0.7, 10.0)
    arguments = (
        GridMap(cells, 0.1),
        scan,
        Pose(0.5, 0.5, 0.1),
        Point(2.5, 1.5),
        0.1,
        cells.astype(np.uint8),
        "astar",
    )
    large = wire.encode(list(arguments), kind.types, blobs=True)
    small = wire.encode(list(arguments), kind.types)
    blob = np.zeros(wire.BLOB_BYTES_MIN + 1, np.uint8)
    named = wire.encode(
        [GridMap(blob.reshape(1, -1).view(np.int8), 0.1), *arguments[1:]], kind.types, blobs=True
    )
    digest, raw = next(iter(named.blobs.items()))
    packed = wire.encode([blob, blob], kind.types, blobs=True, along=lambda _, raw: compress(raw))
    messages: list[wire.Message] = [
        wire.Hello({kind.name: kind.source_hash}, "0.1.0", 1 << 20, ("zstd",)),
        wire.Request(1, kind.name, 1.0, body=small.frames),
        wire.Request(2, kind.name, 1.0, blobs=tuple(large.blobs), body=large.frames),
        wire.Request(3, kind.name, 1.0, attempt=2, blobs=(digest,), body=named.frames),
        wire.Request(5, kind.name, 1.0, body=packed.frames),
        wire.Blob(raw),
        wire.Blob(compress(raw), raw.nbytes),
        wire.Ping(4),
        wire.Cancel(1),
        wire.Reply(1, "ok", body=small.frames),
        wire.Pong(4, 1),
    ]
    return [[bytes(frame) for frame in wire.pack(message)] for message in messages]


def mutate(frames: Frames, rng: random.Random) -> Frames:
    """Make up to four changes: to bits, bytes, lengths, or frames."""
    changed = [bytearray(frame) for frame in frames]
    for _ in range(rng.randint(1, 4)):
        frame = rng.choice(changed)
        at = rng.randrange(len(frame) + 1)
        what = rng.randrange(7)
        if what == 0 and frame:
            frame[at % len(frame)] ^= 1 << rng.randrange(8)
        elif what == 1 and frame:
            frame[at % len(frame)] = rng.choice((0x00, 0x7F, 0x80, 0x90, 0xC1, 0xC9, 0xDD, 0xDF, 0xFF))
        elif what == 2:
            del frame[at:]
        elif what == 3:
            frame[at:at] = rng.randbytes(rng.randint(1, 8))
        elif what == 4:
            frame[at:at] = rng.choice(
                (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff")
            )
        elif what == 5:
            changed.insert(rng.randrange(len(changed) + 1), bytearray(rng.choice(changed)))
        elif len(changed) > 1:
            changed.pop(rng.randrange(len(changed)))
    return [bytes(frame) for frame in changed]


def bombs() -> dict[str, Frames]:
    """Small messages that would take much memory, or run code, if the server believed them."""
    bodies = {**_structure_bombs(), **_array_bombs(), **_value_bombs(), **_pickle_bombs()}
    return {name: request(body) for name, body in bodies.items()} | _header_bombs()


def request(body: Frames, kind: str = "plan_path", blobs: tuple[bytes, ...] = ()) -> Frames:
    return list(wire.pack(wire.Request(1, kind, 1.0, blobs=blobs, body=body)))


def plan_body(grid: Any = None, pose: Any = None, scan: Any = None, radius_m: Any = 0.1) -> Frames:
    """Arguments of `plan_path`, also of wrong types."""
    grid = GridMap(np.zeros((20, 30), np.int8), 0.1) if grid is None else grid
    pose = Pose(0.5, 0.5) if pose is None else pose
    return wire.encode([grid, scan, pose, Point(2.5, 1.5), radius_m], kind_of(plan_path).types).frames


class _Exploit:
    """Runs code when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, ("import os; os._exit(66)",)


def _structure_bombs() -> dict[str, Frames]:
    return {
        "a million nested arrays": [b"\x91" * 1_000_000 + b"\xc0"],
        "a million nested maps": [b"\x81\x01" * 1_000_000 + b"\xc0"],
        "an array of 4 thousand million items": [b"\xdd\xff\xff\xff\xff"],
        "a text of 4 GB": [b"\xdb\xff\xff\xff\xff"],
        "extensions in extensions": [_nested_extension(60)],
    }


def _array_bombs() -> dict[str, Frames]:
    return {
        "a map of 10^9 cells in 10 bytes": _plan_with(_array((31_623, 31_623), bytes(10))),
        "a shape that overflows": _plan_with(_array((2**62, 2**62, 0), b"")),
        "a negative shape": _plan_with(_array((-1, 4), bytes(4))),
        "objects as dtype": _plan_with(_array((1,), bytes(8), "|O")),
        "nine dimensions": _plan_with(_array((1,) * 9, bytes(1))),
        "a compressed map of 10^9 cells": _plan_with(
            _array((31_623, 31_623), bytes(10), code=EXT_COMPRESSED)
        ),
        "a map that unpacks to more cells": _plan_with(
            _array((10, 10), compress(bytes(2**26)), code=EXT_COMPRESSED)
        ),
        "16 MiB in a few bytes, a thousand times": _many_compressed(1000, 2**24),
        "a frame that is not there": [msgpack.packb([msgpack.ExtType(1, msgpack.packb((9, "|i1", (1,))))])],
    }


def _value_bombs() -> dict[str, Frames]:
    nan, inf = float("nan"), float("inf")
    return {
        "NaN as a place": plan_body(pose=Pose(nan, inf)),
        "a negative radius": plan_body(radius_m=-1.0),
        "an endless radius": plan_body(radius_m=1e308),
        "NaN in a scan": plan_body(scan=Scan(np.full(8, nan, np.float32), nan, inf, -1.0)),
        "a scan of a million beams": plan_body(scan=Scan(np.ones(1_000_000, np.float32), 0.0, 1e-6, 9.0)),
    }


def _pickle_bombs() -> dict[str, Frames]:
    code = pickle.dumps(_Exploit())
    return {
        "a pickle": [code],
        "a pickle as an extension": [msgpack.packb([msgpack.ExtType(EXT_DATACLASS, code)])],
        "a dataclass of the standard library": [
            msgpack.packb([msgpack.ExtType(EXT_DATACLASS, msgpack.packb(["os.system", {"command": "id"}]))])
        ],
        "a blob that was not announced": [
            msgpack.packb([msgpack.ExtType(EXT_BLOB, msgpack.packb((bytes(32), "|i1", (1,))))])
        ],
    }


def _header_bombs() -> dict[str, Frames]:
    """Whole messages with a wrong header, kind, or number of frames."""
    fields = {"id": 1, "kind": "plan_path", "budget_s": float("nan"), "attempt": 1, "blobs": []}
    header = msgpack.packb([1, "request", fields])
    return {
        "a path as a task": request([b"\x90"], kind="../../../etc/passwd"),
        "a line break in a name": request(
            [b"\x90"], kind="x\n2026-01-01 00:00:00 INFO robots known: mallory"
        ),
        "a line break in a message type": [msgpack.packb([1, "ping\nINFO robots known: mallory\x1b[2J", {}])],
        "NaN as a budget": [header, b"\x90"],
        "a compressed blob of 2 GB": list(wire.pack(wire.Blob(compress(bytes(1000)), 2**31 - 1))),
        "a compressed blob that is longer": list(wire.pack(wire.Blob(compress(bytes(2**26)), 1000))),
        "a blob of another hash": request([b"\x90"], blobs=(bytes(32),)),
        "64 blobs that are not there": request([b"\x90"], blobs=tuple(bytes([n]) * 32 for n in range(64))),
        "a header of 65 KB": [msgpack.packb([1, "ping", {"id": 1, "x": bytes(65_536)}])],
        "two thousand frames": [header, *[b"\x90"] * 2_000],
        "no frame after the header": [header],
        "an empty message": [b""],
        "a pickle as the header": [pickle.dumps(_Exploit())],
    }


def _array(shape: tuple[int, ...], data: bytes, dtype: str = "|i1", *, code: int = 1) -> Frames:
    """A value that is an array in its own frame; its shape may be wrong."""
    return [msgpack.packb(msgpack.ExtType(code, msgpack.packb((1, dtype, shape)))), data]


def _many_compressed(count: int, size: int) -> Frames:
    """A list of arrays that all are in one compressed frame."""
    one = msgpack.ExtType(EXT_COMPRESSED, msgpack.packb((1, "|i1", (size,))))
    return [msgpack.packb([one] * count), compress(bytes(size))]


def _plan_with(array: Frames) -> Frames:
    """A plan with this array as the cells of its map."""
    grid = msgpack.packb(
        ["GridMap", {"cells": msgpack.unpackb(array[0]), "resolution": 0.1, "origin": [0.0, 0.0, 0.0]}]
    )
    rest = msgpack.unpackb(plan_body()[0])[1:]
    return [msgpack.packb([msgpack.ExtType(EXT_DATACLASS, grid), *rest]), array[1]]


def _nested_extension(depth: int) -> bytes:
    inner = b"\xc0"
    for _ in range(depth):
        inner = msgpack.packb(msgpack.ExtType(EXT_DATACLASS, inner))
    return inner
