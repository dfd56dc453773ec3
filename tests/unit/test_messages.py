"""The messages of the wire format: golden bytes of version 1, and ProtocolError for malformed messages."""

import random
from typing import Any

import msgpack
import numpy as np
import pytest

from offboard.common.errors import BadValue, ProtocolError
from offboard.common.source.covers import HASH_LENGTH
from offboard.common.task_call import TRACEBACK_LENGTH_MAX
from offboard.common.tasks import KINDS_MAX
from offboard.common.wire import messages as wire
from offboard.common.wire.messages import Blob, Cancel, Hello, Ping, Pong, Reply, Request
from tests.wire_values import Pose, mutate

DIGEST = bytes(range(32))
REQUEST = {"id": 1, "kind": "k", "budget_s": 1.0, "attempt": 1, "blobs": []}
REPLY = {"id": 1, "status": "ok", "error": "", "queue_s": 0.0, "run_s": 0.0, "queue_depth": 0, "missing": []}
REPLY |= {"server_fault": False}
GOLDEN: list[tuple[wire.Message, str]] = [
    (
        Hello({"plan_path": "ab12"}, "0.1.0", 4096),
        "9301a568656c6c6f83a57461736b7381a9706c616e5f70617468a461623132a8736f667477617265a5302e312e30"
        "b16d6573736167655f62797465735f6d6178cd1000",
    ),
    (
        Request(7, "plan_path", 0.25, 2, (DIGEST,), [b"\x90"]),
        "9301a77265717565737485a2696407a46b696e64a9706c616e5f70617468a86275646765745f73cb3fd0000000000000"
        "a7617474656d707402a5626c6f627391c420" + DIGEST.hex() + "|90",
    ),
    (
        Reply(7, "ok", "", 0.5, 0.25, 3, (), False, [b"\xc0", b"raw"]),
        "9301a57265706c7988a2696407a6737461747573a26f6ba56572726f72a0a771756575655f73cb3fe0000000000000"
        "a572756e5f73cb3fd0000000000000ab71756575655f646570746803a76d697373696e6790ac7365727665725f6661756c74c2|c0|726177",
    ),
    (
        Reply(7, "failed", "why", 0.5, 0.25, 3, (), True, cpu_s=0.125),
        "9301a57265706c7989a2696407a6737461747573a66661696c6564a56572726f72a3776879a771756575655f73cb3fe0000000000000"
        "a572756e5f73cb3fd0000000000000ab71756575655f646570746803a76d697373696e6790ac7365727665725f6661756c74c3"
        "a56370755f73cb3fc0000000000000",
    ),
    (Ping(1), "9301a470696e6781a2696401"),
    (Pong(1, 2), "9301a4706f6e6782a2696401ab71756575655f646570746802"),
    (
        Pong(1, 0, 0.5, 0.25),
        "9301a4706f6e6784a2696401ab71756575655f646570746800a46c6f6164cb3fe0000000000000"
        "a86361706163697479cb3fd0000000000000",
    ),
    (Cancel(2**63 - 1), "9301a663616e63656c81a26964cf7fffffffffffffff"),
    (Blob(b"map"), "9301a4626c6f6280|6d6170"),
    (Blob(b"map", 1000), "9301a4626c6f6281a473697a65cd03e8|6d6170"),
    (
        Hello({}, "1", 4096, ("zstd",)),
        "9301a568656c6c6f84a57461736b7380a8736f667477617265a131b16d6573736167655f62797465735f6d6178cd1000"
        "ac636f6d7072657373696f6e7391a47a737464",
    ),
]


@pytest.mark.parametrize(("message", "golden"), GOLDEN, ids=lambda case: type(case).__name__)
def test_messages_of_version_1_have_these_bytes(message: wire.Message, golden: str) -> None:
    """Packing a message gives exactly these frames, and unpacking them gives the message."""
    frames = [bytes.fromhex(part) for part in golden.split("|")]
    assert [bytes(frame).hex() for frame in wire.pack(message)] == [frame.hex() for frame in frames]
    assert wire.unpack(frames) == message


def test_unknown_fields_are_ignored() -> None:
    """Later software may add fields to version 1."""
    assert wire.unpack([msgpack.packb([1, "ping", {"id": 5, "later": [1, 2]}])]) == Ping(5)


def test_the_cpu_time_of_a_reply_is_optional() -> None:
    """It is not sent if it is unknown, and it is None if an older server did not send it."""
    assert b"cpu_s" not in wire.pack(Reply(7, "busy"))[0]
    reply = wire.unpack([msgpack.packb([1, "reply", REPLY]), b"\xc0"])
    assert isinstance(reply, Reply)
    assert reply.cpu_s is None


def test_the_traceback_of_a_reply_is_optional() -> None:
    """An empty one is not sent, a long one loses its beginning, and an older server sends none."""
    assert b"traceback" not in wire.pack(Reply(7, "busy"))[0]
    reply = wire.unpack([msgpack.packb([1, "reply", REPLY]), b"\xc0"])
    assert isinstance(reply, Reply)
    assert reply.traceback == ""
    long = wire.unpack(wire.pack(Reply(7, "failed", "why", traceback="\udc80" + "ä" * 9_000 + "end")))
    assert isinstance(long, Reply)
    assert long.traceback == "..." + "ä" * (TRACEBACK_LENGTH_MAX - 6) + "end"


def test_a_server_without_load_and_capacity_is_idle() -> None:
    """An older server does not know these fields, and an idle server does not send them."""
    assert wire.unpack([msgpack.packb([1, "pong", {"id": 5, "queue_depth": 2}])]) == Pong(5, 2, 0.0, 1.0)
    for message in (Pong(5, 2), Reply(7, "busy")):
        assert not any(field in wire.pack(message)[0] for field in (b"load", b"capacity"))


@pytest.mark.parametrize("field", ["load", "capacity"])
@pytest.mark.parametrize("share", [-0.01, 1.01, float("nan"), "1", True, None])
def test_a_wrong_load_or_capacity_is_refused(field: str, share: Any) -> None:
    """A capacity of 0 is refused too, because times are divided by it."""
    for name, fields, rest in (("pong", {"id": 5, "queue_depth": 2}, []), ("reply", REPLY, [b"\xc0"])):
        assert wire.unpack([msgpack.packb([1, name, fields | {field: 1}]), *rest])
        for wrong in (share, 0) if field == "capacity" else (share,):
            with pytest.raises(ProtocolError, match=rf"{name}\.{field}"):
                wire.unpack([msgpack.packb([1, name, fields | {field: wrong}]), *rest])


@pytest.mark.parametrize("cpu_s", [-1e-9, float("nan"), float("inf"), 1e7, "1", True, None])
def test_a_wrong_cpu_time_is_refused(cpu_s: Any) -> None:
    """A CPU time that is not a number 0 to 1e6 is a ProtocolError."""
    assert wire.unpack([msgpack.packb([1, "reply", REPLY | {"cpu_s": 0}]), b"\xc0"])
    with pytest.raises(ProtocolError, match=r"reply\.cpu_s"):
        wire.unpack([msgpack.packb([1, "reply", REPLY | {"cpu_s": cpu_s}]), b"\xc0"])


@pytest.mark.parametrize("header", [[2, "ping", {"id": 1}], [0], [2, {"all": "different"}, 1, 2]])
def test_another_version_is_recognised(header: list[Any]) -> None:
    """After another version number, any content is a VersionMismatch."""
    with pytest.raises(wire.VersionMismatch, match=f"version {header[0]}"):
        wire.unpack([msgpack.packb(header)])


@pytest.mark.parametrize(
    ("name", "fields", "wrong"),
    [
        ("request", REQUEST, {"id": -1}),
        ("request", REQUEST, {"id": 2**63}),
        ("request", REQUEST, {"id": True}),
        ("request", REQUEST, {"id": None}),
        ("request", REQUEST, {"kind": ""}),
        ("request", REQUEST, {"kind": "k" * 65}),
        ("request", REQUEST, {"kind": b"k"}),
        ("request", REQUEST, {"budget_s": 0}),
        ("request", REQUEST, {"budget_s": float("nan")}),
        ("request", REQUEST, {"budget_s": float("inf")}),
        ("request", REQUEST, {"budget_s": 1e7}),
        ("request", REQUEST, {"attempt": 0}),
        ("request", REQUEST, {"blobs": [DIGEST[:-1]]}),
        ("request", REQUEST, {"blobs": [DIGEST] * 65}),
        ("request", REQUEST, {"blobs": DIGEST}),
        ("reply", REPLY, {"status": "great"}),
        ("reply", REPLY, {"status": "busy"}),
        ("reply", REPLY, {"error": "e" * 2001}),
        ("reply", REPLY, {"queue_s": -0.1}),
        ("reply", REPLY, {"run_s": "1"}),
        ("reply", REPLY, {"queue_depth": 1.5}),
        ("reply", REPLY, {"missing": [1]}),
        ("reply", REPLY, {"server_fault": 1}),
    ],
)
def test_a_wrong_field_is_refused(name: str, fields: dict[str, Any], wrong: dict[str, Any]) -> None:
    """A field that is missing, of the wrong type or out of range is a ProtocolError."""
    assert wire.unpack([msgpack.packb([1, name, fields]), b"\xc0"])
    with pytest.raises(ProtocolError):
        wire.unpack([msgpack.packb([1, name, fields | wrong]), b"\xc0"])
    missing = {key: value for key, value in fields.items() if key not in wrong}
    with pytest.raises(ProtocolError):
        wire.unpack([msgpack.packb([1, name, missing]), b"\xc0"])


@pytest.mark.parametrize(
    "tasks", [{"": "h"}, {"n" * 65: "h"}, {"n": "h" * 129}, {1: "h"}, {str(n): "" for n in range(257)}]
)
def test_the_tasks_of_a_hello_are_limited(tasks: dict[Any, str]) -> None:
    """The lengths of names and hashes and their number are limited."""
    with pytest.raises(ProtocolError):
        wire.unpack([msgpack.packb([1, "hello", {"tasks": tasks, "software": "1"}])])


@pytest.mark.parametrize("words", ["zstd", None, ["z" * 129], [b"zstd"], ["zstd"] * 17])
def test_the_compressions_of_a_hello_are_limited(words: Any) -> None:
    """They are a short list of short texts; a hello without them is one of an older version."""
    fields: dict[str, Any] = {"tasks": {}, "software": "1", "message_bytes_max": 1}
    hello = wire.unpack([msgpack.packb([1, "hello", fields])])
    assert hello == Hello({}, "1", 1)
    with pytest.raises(ProtocolError, match=r"hello\.compressions"):
        wire.unpack([msgpack.packb([1, "hello", fields | {"compressions": words}])])


@pytest.mark.parametrize("size", [0, -1, 2**31, 1.0, "1", None])
def test_the_size_of_a_blob_is_limited(size: Any) -> None:
    """It is a whole number from 1, or left out."""
    assert wire.unpack([msgpack.packb([1, "blob", {}]), b"x"]) == Blob(b"x")
    with pytest.raises(ProtocolError, match=r"blob\.size"):
        wire.unpack([msgpack.packb([1, "blob", {"size": size}]), b"x"])


@pytest.mark.parametrize(
    "frames",
    [
        [],
        [msgpack.packb([1, "ping", {"id": 1}]), b"extra"],
        [msgpack.packb([1, "blob", {}])],
        [msgpack.packb([1, "request", REQUEST])],
        [msgpack.packb([1, "reply", REPLY])],
        [msgpack.packb([1, "ping", {"id": 1, "pad": "x" * 65_536}])],
        [msgpack.packb([1, "request", REQUEST])] + [b""] * 1002,
    ],
)
def test_the_number_of_frames_is_limited(frames: list[bytes]) -> None:
    """Too many frames, too few, and a header over 64 KiB are ProtocolErrors."""
    with pytest.raises(ProtocolError):
        wire.unpack(frames)


def test_a_long_error_text_is_shortened() -> None:
    """An error of any length and with broken characters still gives a valid reply."""
    reply = wire.unpack(wire.pack(Reply(1, "failed", "\udc80" + "ä" * 10_000)))
    assert isinstance(reply, Reply)
    assert reply.error == "?" + "ä" * 1999


def test_garbage_only_raises_protocol_error() -> None:
    """Random frames and damaged messages raise no other exception."""
    chance = random.Random(5)
    body = wire.encode([np.arange(9.0), Pose(1, 2, ["a"]), {"k": b"v"}], [Pose])
    valid = [wire.pack(message) for message, _ in GOLDEN] + [wire.pack(Request(1, "k", 1, body=body.frames))]
    refused = 0
    for _ in range(3000):
        frames = [bytes(frame) for frame in chance.choice(valid)]
        mutate(chance, frames)
        try:
            message = wire.unpack(frames)
            if isinstance(message, Request):
                wire.decode(message.body, [Pose], {})
        except ProtocolError:
            refused += 1
    assert 500 < refused < 3000


def test_a_message_that_is_too_large_is_not_packed() -> None:
    """The limits hold for sent messages too."""
    with pytest.raises(BadValue):
        wire.pack(Hello({f"task_{n:05}": "h" * 64 for n in range(1000)}, "1", 1))


def test_the_largest_hello_fits_into_a_header() -> None:
    """As many tasks as a process may have, with names and hashes of full length, files included."""
    names = [f"{number:064}" for number in range(KINDS_MAX)]
    hello = Hello(dict.fromkeys(names, "f" * 2 * HASH_LENGTH), "0.1.0", 4096)
    assert wire.unpack(wire.pack(hello)) == hello
