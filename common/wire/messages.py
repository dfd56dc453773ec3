"""The messages between robot and server, version 1: a small msgpack header, then raw frames.

Frame 0 is `[VERSION, type, fields]`; a reader ignores fields it does not know, so version 1 can grow.
Arguments and results are `common.wire.values`, whose names can be had from here too.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

import msgpack

from offboard.common.errors import BadValue, ProtocolError
from offboard.common.tasks import KINDS_MAX, NAME_LENGTH_MAX
from offboard.common.wire.blobs import BlobStore, Buffer, StoredBlob
from offboard.common.wire.values import (
    ARRAYS_MAX,
    BLOB_BYTES_MIN,
    BLOBS_MAX,
    Body,
    decode,
    encode,
    unpack_bounded,
)

__all__ = [
    "BLOB_BYTES_MIN",
    "VERSION",
    "Blob",
    "BlobStore",
    "Body",
    "Buffer",
    "Cancel",
    "Hello",
    "Message",
    "Ping",
    "Pong",
    "Reply",
    "Request",
    "StoredBlob",
    "VersionMismatch",
    "byte_count",
    "decode",
    "encode",
    "pack",
    "unpack",
]

VERSION = 1
HEADER_BYTES_MAX = 64 * 1024
FRAMES_MAX = 2 + ARRAYS_MAX  # header, value, its arrays
TEXT_LENGTH_MAX = 128  # software version, source hash
ERROR_LENGTH_MAX = 2000
ID_MAX = 2**63 - 1
COUNT_MAX = 2**31 - 1
SECONDS_MAX = 1e6
DIGEST_BYTES = 32
IDLE = {"load": 0.0, "capacity": 1.0}  # what a server has that does not say
STATUSES = ("ok", "failed", "unknown_task", "busy", "expired", "need_blob")


class VersionMismatch(ProtocolError):
    """The peer speaks another version of the wire format."""


@dataclass(frozen=True, slots=True)
class Hello:
    """First message each way: the task names known, with the hash of each one's source.

    `message_bytes_max` is the largest message that the sender takes.
    """

    tasks: dict[str, str]
    software: str
    message_bytes_max: int


@dataclass(slots=True)
class Request:
    """Run a task: `body` is the encoded list of its arguments, `blobs` the digests that it refers to.

    `budget_s` is the time left when it was sent; `attempt` counts from 1 and grows when the same id is
    sent again after `need_blob`.
    """

    id: int
    kind: str
    budget_s: float
    attempt: int = 1
    blobs: tuple[bytes, ...] = ()
    body: list[Buffer] = field(default_factory=list)


@dataclass(slots=True)
class Reply:
    """How a request went; `body` is the encoded result, empty unless `status` is ok.

    `server_fault`: it failed, but not by the task's own doing, so another site may well answer. `cpu_s` is
    the CPU time that the server used while the task ran; None, and not sent, where it did not run, or where
    the server is older than the field. `load` and `capacity` are as in a pong.
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


@dataclass(frozen=True, slots=True)
class Ping:
    id: int


@dataclass(frozen=True, slots=True)
class Pong:
    """How the server is: tasks in its queue; `load`: the share of its CPU that other programs take, 0 to 1;
    `capacity`: so much of one CPU may a task use, above 0 to 1. The last two are sent where they differ from
    an idle machine's.
    """

    id: int
    queue_depth: int = 0
    load: float = 0.0
    capacity: float = 1.0


@dataclass(frozen=True, slots=True)
class Cancel:
    """The answer to this request is no longer wanted."""

    id: int


@dataclass(frozen=True, slots=True)
class Blob:
    """The bytes of one blob; the receiver computes the digest itself."""

    data: Buffer


Message = Hello | Request | Reply | Ping | Pong | Cancel | Blob


def pack(message: Message) -> list[Buffer]:
    """The frames of a message; buffers in it are not copied. BadValue where it breaks a bound."""
    kind, names = _FIELDS[type(message)]
    fields = {field: getattr(message, field) for field in names}
    if isinstance(message, Reply):
        if message.error:
            fields["error"] = message.error[:ERROR_LENGTH_MAX].encode("utf-8", "replace").decode()
        if message.cpu_s is None:
            del fields["cpu_s"]
    if isinstance(message, Reply | Pong):
        for name, idle in IDLE.items():
            if fields[name] == idle:
                del fields[name]
    header: bytes = msgpack.packb([VERSION, kind, fields])
    frames: list[Buffer] = [header]
    if isinstance(message, Request | Reply):
        frames += message.body
    elif isinstance(message, Blob):
        frames.append(message.data)
    if len(header) > HEADER_BYTES_MAX or len(frames) > FRAMES_MAX:
        raise BadValue(f"a {kind} with a header of {len(header)} bytes and {len(frames)} frames is too big")
    return frames


def unpack(frames: Sequence[Buffer]) -> Message:
    """The message in `frames`; VersionMismatch for another version, ProtocolError for all else."""
    if not 1 <= len(frames) <= FRAMES_MAX:
        raise ProtocolError(f"message of {len(frames)} frames, 1 to {FRAMES_MAX} are allowed")
    header = unpack_bounded(frames[0], HEADER_BYTES_MAX)
    if not isinstance(header, list) or not header or type(header[0]) is not int:
        raise ProtocolError("header is not [version, type, fields]")
    if header[0] != VERSION:
        raise VersionMismatch(f"peer speaks wire version {header[0]}, this is version {VERSION}")
    if len(header) != 3 or not isinstance(header[1], str) or not isinstance(header[2], dict):
        raise ProtocolError("header is not [version, type, fields]")
    read = _READERS.get(header[1])
    if read is None:
        raise ProtocolError(f"unknown message type {header[1]!r:.80}")
    return read(_Fields(header[1], header[2]), list(frames[1:]))


def byte_count(frames: Iterable[Buffer]) -> int:
    """Bytes in all frames, without transport headers."""
    return sum(f.nbytes if isinstance(f, memoryview) else len(f) for f in frames)


class _Fields:
    """Takes checked values out of a header's map."""

    def __init__(self, message: str, values: dict[Any, Any]) -> None:
        self.message = message
        self.values = values

    def whole(self, name: str, low: int, high: int) -> int:
        value = self.values.get(name)
        if type(value) is not int or not low <= value <= high:
            raise self.wrong(name, f"a whole number {low} to {high}")
        return value

    def seconds(self, name: str) -> float:
        value: Any = self.values.get(name)
        if type(value) not in (int, float) or not (math.isfinite(value) and 0 <= value <= SECONDS_MAX):
            raise self.wrong(name, f"a number 0 to {SECONDS_MAX:g}")
        return float(value)

    def share(self, name: str) -> float:
        value: Any = self.values.get(name, IDLE[name])
        if type(value) not in (int, float) or not 0 <= value <= 1 or (name == "capacity" and not value):
            raise self.wrong(name, f"a share {'above ' if name == 'capacity' else ''}0 to 1")
        return float(value)

    def text(self, name: str, length_max: int) -> str:
        value = self.values.get(name)
        if not isinstance(value, str) or len(value) > length_max:
            raise self.wrong(name, f"a text of at most {length_max} characters")
        return value

    def flag(self, name: str) -> bool:
        value = self.values.get(name)
        if type(value) is not bool:
            raise self.wrong(name, "true or false")
        return value

    def digests(self, name: str) -> tuple[bytes, ...]:
        value = self.values.get(name)
        if not isinstance(value, list) or len(value) > BLOBS_MAX:
            raise self.wrong(name, f"a list of at most {BLOBS_MAX} digests")
        if not all(isinstance(item, bytes) and len(item) == DIGEST_BYTES for item in value):
            raise self.wrong(name, f"a list of digests of {DIGEST_BYTES} bytes")
        return tuple(value)

    def tasks(self, name: str) -> dict[str, str]:
        value = self.values.get(name)
        if not isinstance(value, dict) or len(value) > KINDS_MAX:
            raise self.wrong(name, f"a map of at most {KINDS_MAX} tasks")
        for key, text in value.items():
            if not (isinstance(key, str) and 0 < len(key) <= NAME_LENGTH_MAX):
                raise self.wrong(name, f"a map of names of 1 to {NAME_LENGTH_MAX} characters")
            if not (isinstance(text, str) and len(text) <= TEXT_LENGTH_MAX):
                raise self.wrong(name, f"a map to texts of at most {TEXT_LENGTH_MAX} characters")
        return value

    def wrong(self, name: str, allowed: str) -> ProtocolError:
        return ProtocolError(f"{self.message}.{name} is {self.values.get(name)!r:.80}, not {allowed}")


def _hello(fields: _Fields, rest: list[Buffer]) -> Hello:
    _frame_count("hello", rest, 0)
    return Hello(
        fields.tasks("tasks"),
        fields.text("software", TEXT_LENGTH_MAX),
        fields.whole("message_bytes_max", 1, COUNT_MAX),
    )


def _request(fields: _Fields, rest: list[Buffer]) -> Request:
    kind, budget_s = fields.text("kind", NAME_LENGTH_MAX), fields.seconds("budget_s")
    if not kind or not budget_s > 0:
        raise ProtocolError("request without a kind or a budget")
    if not rest:
        raise ProtocolError("request without a body")
    attempt = fields.whole("attempt", 1, COUNT_MAX)
    return Request(fields.whole("id", 0, ID_MAX), kind, budget_s, attempt, fields.digests("blobs"), rest)


def _reply(fields: _Fields, rest: list[Buffer]) -> Reply:
    status = fields.text("status", TEXT_LENGTH_MAX)
    if status not in STATUSES:
        raise fields.wrong("status", f"one of {', '.join(STATUSES)}")
    if (status == "ok") != bool(rest):
        raise ProtocolError(f"reply with status {status} and {len(rest)} body frames")
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
    )


def _ping(fields: _Fields, rest: list[Buffer]) -> Ping:
    _frame_count("ping", rest, 0)
    return Ping(fields.whole("id", 0, ID_MAX))


def _pong(fields: _Fields, rest: list[Buffer]) -> Pong:
    _frame_count("pong", rest, 0)
    queue = fields.whole("queue_depth", 0, COUNT_MAX)
    return Pong(fields.whole("id", 0, ID_MAX), queue, fields.share("load"), fields.share("capacity"))


def _cancel(fields: _Fields, rest: list[Buffer]) -> Cancel:
    _frame_count("cancel", rest, 0)
    return Cancel(fields.whole("id", 0, ID_MAX))


def _blob(_: _Fields, rest: list[Buffer]) -> Blob:
    _frame_count("blob", rest, 1)
    return Blob(rest[0])


def _frame_count(name: str, rest: list[Buffer], wanted: int) -> None:
    if len(rest) != wanted:
        raise ProtocolError(f"{name} with {len(rest)} frames after the header, not {wanted}")


_RAW = ("body", "data")  # what follows the header in frames of its own
_FIELDS: dict[type, tuple[str, list[str]]] = {
    kind: (kind.__name__.lower(), [one.name for one in dataclasses.fields(kind) if one.name not in _RAW])
    for kind in get_args(Message)
}
_READERS: dict[str, Callable[[_Fields, list[Buffer]], Message]] = {
    "hello": _hello,
    "request": _request,
    "reply": _reply,
    "ping": _ping,
    "pong": _pong,
    "cancel": _cancel,
    "blob": _blob,
}
