"""The messages between robot and server, version 1: a small msgpack header, then raw frames.

Frame 0 is `[VERSION, type, fields]`. A reader ignores unknown fields, so version 1 can get more of them.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import get_args

import msgpack

from offboard.common.errors import BadValue, ProtocolError
from offboard.common.task_call import TRACEBACK_LENGTH_MAX, bounded
from offboard.common.tasks import NAME_LENGTH_MAX
from offboard.common.together import KEY_LENGTH_MAX
from offboard.common.wire.blobs import BlobStore, Buffer, StoredBlob
from offboard.common.wire.fields import IDLE, TEXT_LENGTH_MAX, Fields
from offboard.common.wire.values import ARRAYS_MAX, BLOB_BYTES_MIN, Body, decode, encode, unpack_bounded

# What is defined elsewhere: a message holds encoded values, and the store their large arguments.
__all__ = ["BLOB_BYTES_MIN", "BlobStore", "Body", "Buffer", "StoredBlob", "decode", "encode"]

VERSION = 1
HEADER_BYTES_MAX = 64 * 1024
FRAMES_MAX = 2 + ARRAYS_MAX  # header, value, arrays
ERROR_LENGTH_MAX = 2000
ID_MAX = 2**63 - 1
COUNT_MAX = 2**31 - 1
MICROSECONDS = 6  # digits of a wait: a robot keeps it in a file, which takes no smaller number
STATUSES = ("ok", "failed", "unknown_task", "busy", "expired", "need_blob")


class VersionMismatch(ProtocolError):
    """The peer speaks another version of the wire format."""


@dataclass(frozen=True, slots=True)
class Hello:
    """The first message in each direction.

    `tasks` maps each known task to the hash of its source. The sender accepts messages of up to
    `message_bytes_max`, and arguments that one of `compressions` has compressed.
    """

    tasks: dict[str, str]
    software: str
    message_bytes_max: int
    compressions: tuple[str, ...] = ()


@dataclass(slots=True)
class Request:
    """Run a task. `body` is the encoded list of arguments, `blobs` are the digests that it refers to.

    `budget_s` is the time that was left when the request was sent. `attempt` starts at 1 and grows when the
    same id is sent again after `need_blob`. `key`: only requests with equal keys may run together.
    `useless_s`: in how many seconds nobody needs the answer any more; None: it is in no hurry.
    """

    id: int
    kind: str
    budget_s: float
    attempt: int = 1
    blobs: tuple[bytes, ...] = ()
    body: list[Buffer] = field(default_factory=list)
    key: str = ""
    useless_s: float | None = None


@dataclass(slots=True)
class Reply:
    """The answer to a request. `body` is the encoded result; it is empty unless `status` is ok.

    `server_fault`: the task failed, but the task is not the cause, so another site may answer it. `cpu_s` is
    the CPU time that the server used while the task ran. It is None, and not sent, if the task did not run or
    if the server is too old to send it. `load` and `capacity` are as in a pong. `traceback` is that of a task
    that raised; an empty one is not sent. If other requests ran with it, `run_s` is what it would have taken
    alone, and the rest counts as `queue_s`. `waits_s`: as in a pong.
    """

    id: int
    status: str
    error: str = ""
    queue_s: float = 0.0
    run_s: float = 0.0
    queue_depth: int = 0
    missing: tuple[bytes, ...] = ()
    server_fault: bool = False
    body: list[Buffer] = field(default_factory=list)
    cpu_s: float | None = None
    load: float = 0.0
    capacity: float = 1.0
    traceback: str = ""
    waits_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Ping:
    id: int


@dataclass(frozen=True, slots=True)
class Pong:
    """The state of the server: the number of waiting tasks, its load, and its capacity.

    `load` is the share of the CPU that other programs take, 0 to 1. `capacity` is the share of one CPU that a
    task may use, above 0 and at most 1. Both are sent only if they differ from those of an idle machine.
    `waits_s`: the seconds that a request that came now would wait, also for those that would run with it. It
    is sent by servers where requests run together, and where one is refused because it would be too late.
    """

    id: int
    queue_depth: int = 0
    load: float = 0.0
    capacity: float = 1.0
    waits_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Cancel:
    """The sender does not want the answer to this request any more."""

    id: int


@dataclass(frozen=True, slots=True)
class Blob:
    """The bytes of one blob. The receiver computes the digest itself.

    `size`: how many bytes there are once `data` is decompressed; None if it is not compressed.
    """

    data: Buffer
    size: int | None = None


Message = Hello | Request | Reply | Ping | Pong | Cancel | Blob


def pack(message: Message) -> list[Buffer]:
    """The frames of a message; its buffers are not copied. BadValue if the message is too large."""
    kind, names, optional = _FIELDS[type(message)]
    fields = {field: getattr(message, field) for field in names}
    for name, absent in optional:
        if (value := getattr(message, name)) != absent:
            fields[name] = value
    if kind == "reply":
        if fields["error"]:
            fields["error"] = _sendable(fields["error"][:ERROR_LENGTH_MAX])
        if "traceback" in fields:
            fields["traceback"] = _sendable(bounded(fields["traceback"]))
    header: bytes = msgpack.packb([VERSION, kind, fields])
    frames: list[Buffer] = [header]
    if isinstance(message, Request | Reply):
        frames += message.body
    elif isinstance(message, Blob):
        frames.append(message.data)
    if len(header) > HEADER_BYTES_MAX or len(frames) > FRAMES_MAX:
        raise BadValue(
            f"a {kind} has a header of {len(header)} bytes and {len(frames)} frames; "
            f"at most {HEADER_BYTES_MAX} bytes and {FRAMES_MAX} frames are allowed"
        )
    return frames


def _sendable(text: str) -> str:
    return text.encode("utf-8", "replace").decode()


def unpack(frames: Sequence[Buffer]) -> Message:
    """The message in `frames`. VersionMismatch for another version, ProtocolError for any other fault."""
    if not 1 <= len(frames) <= FRAMES_MAX:
        raise ProtocolError(f"message of {len(frames)} frames; allowed are 1 to {FRAMES_MAX}")
    header = unpack_bounded(frames[0], HEADER_BYTES_MAX)
    if not isinstance(header, list) or not header or type(header[0]) is not int:
        raise ProtocolError("header is not [version, type, fields]")
    if header[0] != VERSION:
        raise VersionMismatch(f"the other side speaks wire version {header[0]}, this side {VERSION}")
    if len(header) != 3 or not isinstance(header[1], str) or not isinstance(header[2], dict):
        raise ProtocolError("header is not [version, type, fields]")
    name, rest = header[1], list(frames[1:])
    read = _READERS.get(name)
    if read is None:
        raise ProtocolError(f"unknown message type {name!r:.80}")
    if len(rest) != _FRAMES.get(name, len(rest)):
        raise ProtocolError(f"{name} with {len(rest)} frames after the header; it must have {_FRAMES[name]}")
    return read(Fields(name, header[2]), rest)


def byte_count(frames: Iterable[Buffer]) -> int:
    """The bytes in all frames, without the headers of the transport."""
    return sum([f.nbytes if isinstance(f, memoryview) else len(f) for f in frames])


def _request(fields: Fields, rest: list[Buffer]) -> Request:
    kind, budget_s = fields.text("kind", NAME_LENGTH_MAX), fields.seconds("budget_s")
    if not kind or not budget_s > 0:
        raise ProtocolError("request without a kind or a budget")
    if not rest:
        raise ProtocolError("request without a body")
    attempt = fields.whole("attempt", 1, COUNT_MAX)
    id, blobs = fields.whole("id", 0, ID_MAX), fields.digests("blobs")
    key = fields.text("key", KEY_LENGTH_MAX) if "key" in fields.values else ""
    useless_s = fields.seconds("useless_s") if "useless_s" in fields.values else None
    return Request(id, kind, budget_s, attempt, blobs=blobs, body=rest, key=key, useless_s=useless_s)


def _reply(fields: Fields, rest: list[Buffer]) -> Reply:
    status = fields.text("status", TEXT_LENGTH_MAX)
    if status not in STATUSES:
        raise fields.wrong("status", f"one of {', '.join(STATUSES)}")
    if (status == "ok") != bool(rest):
        raise ProtocolError(f"reply with status {status} and {len(rest)} frames of body")
    return Reply(
        id=fields.whole("id", 0, ID_MAX),
        status=status,
        error=fields.text("error", ERROR_LENGTH_MAX),
        queue_s=fields.seconds("queue_s"),
        run_s=fields.seconds("run_s"),
        queue_depth=fields.whole("queue_depth", 0, COUNT_MAX),
        missing=fields.digests("missing"),
        server_fault=fields.flag("server_fault"),
        body=rest,
        cpu_s=fields.seconds("cpu_s") if "cpu_s" in fields.values else None,
        load=fields.share("load"),
        capacity=fields.share("capacity"),
        traceback=fields.text("traceback", TRACEBACK_LENGTH_MAX) if "traceback" in fields.values else "",
        waits_s=round(fields.seconds("waits_s"), MICROSECONDS) if "waits_s" in fields.values else 0.0,
    )


_RAW = ("body", "data")  # fields that follow the header as frames
# Fields that are not sent while they have this value.
_OPTIONAL: dict[str, object] = {
    **IDLE,
    "cpu_s": None, "traceback": "", "compressions": (), "size": None,
    "key": "", "useless_s": None, "waits_s": 0.0,
}  # fmt: skip
_NAMES = {kind: [one.name for one in dataclasses.fields(kind)] for kind in get_args(Message)}
_FIELDS: dict[type, tuple[str, list[str], list[tuple[str, object]]]] = {
    kind: (
        kind.__name__.lower(),
        [name for name in names if name not in _RAW and name not in _OPTIONAL],
        [(name, _OPTIONAL[name]) for name in names if name in _OPTIONAL],
    )
    for kind, names in _NAMES.items()
}
_FRAMES = {"hello": 0, "ping": 0, "pong": 0, "cancel": 0, "blob": 1}  # after the header; others: any number
_READERS: dict[str, Callable[[Fields, list[Buffer]], Message]] = {
    "hello": lambda fields, _: Hello(
        fields.tasks("tasks"),
        fields.text("software", TEXT_LENGTH_MAX),
        fields.whole("message_bytes_max", 1, COUNT_MAX),
        fields.words("compressions"),
    ),
    "request": _request,
    "reply": _reply,
    "ping": lambda fields, _: Ping(fields.whole("id", 0, ID_MAX)),
    "pong": lambda fields, _: Pong(
        queue_depth=fields.whole("queue_depth", 0, COUNT_MAX),
        id=fields.whole("id", 0, ID_MAX),
        load=fields.share("load"),
        capacity=fields.share("capacity"),
        waits_s=round(fields.seconds("waits_s"), MICROSECONDS) if "waits_s" in fields.values else 0.0,
    ),
    "cancel": lambda fields, _: Cancel(fields.whole("id", 0, ID_MAX)),
    "blob": lambda fields, rest: Blob(
        rest[0], fields.whole("size", 1, COUNT_MAX) if "size" in fields.values else None
    ),
}
