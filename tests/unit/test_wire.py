"""The wire format: golden bytes of version 1, values there and back, ProtocolError for the rest."""

import hashlib
import random
import tracemalloc
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from offboard.common.errors import BadValue, ProtocolError
from offboard.common.wire import blobs, values
from offboard.common.wire import messages as wire
from offboard.common.wire.messages import (
    Blob,
    BlobStore,
    Cancel,
    Hello,
    Ping,
    Pong,
    Reply,
    Request,
    StoredBlob,
)

DIGEST = bytes(range(32))


@dataclass(frozen=True)
class Pose:
    x: float
    y: float
    tags: list[Any]


@dataclass(frozen=True)
class Positive:
    value: float

    def __post_init__(self) -> None:
        if self.value <= 0:
            raise ValueError("value must be above 0")


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
]


@pytest.mark.parametrize(("message", "golden"), GOLDEN, ids=lambda case: type(case).__name__)
def test_version_1_is_these_bytes(message: wire.Message, golden: str) -> None:
    """A message of version 1 packs to exactly these frames, and these frames are that message."""
    frames = [bytes.fromhex(part) for part in golden.split("|")]
    assert [bytes(frame).hex() for frame in wire.pack(message)] == [frame.hex() for frame in frames]
    assert wire.unpack(frames) == message


def test_version_1_encodes_values_as_these_bytes() -> None:
    """Arrays, blobs and dataclasses have the extension codes 1, 2 and 3 of version 1."""
    array, big = np.array([1, 2], "<i2"), bytes(64 * 1024 + 1)
    body = wire.encode([array, Pose(1, 2, []), big], [Pose], blobs=True)
    digest = hashlib.sha256(big).hexdigest()
    wanted = (
        "93"
        "d7019301a33c69329102"  # array: frame 1, "<i2", [2]
        "c7130392a4506f736583a17801a17902a47461677390"  # dataclass: "Pose", its fields
        "c7250293c420" + digest + "c090"  # blob: digest, no dtype, no shape
    )
    assert bytes(body.frames[0]).hex() == wanted
    assert bytes(body.frames[1]) == b"\x01\x00\x02\x00"
    assert list(body.blobs) == [bytes.fromhex(digest)]


def test_unknown_fields_are_ignored() -> None:
    """A later version 1 may add fields."""
    assert wire.unpack([msgpack.packb([1, "ping", {"id": 5, "later": [1, 2]}])]) == Ping(5)


def test_a_reply_without_cpu_time_is_as_it_was() -> None:
    """The field is optional: not sent where there is no figure, None where an older server left it out."""
    assert b"cpu_s" not in wire.pack(Reply(7, "busy"))[0]
    reply = wire.unpack([msgpack.packb([1, "reply", REPLY]), b"\xc0"])
    assert isinstance(reply, Reply)
    assert reply.cpu_s is None


def test_a_server_that_does_not_say_how_its_cpu_is_is_idle() -> None:
    """One of before these fields, and one that has nothing to say: an idle machine's are not sent."""
    assert wire.unpack([msgpack.packb([1, "pong", {"id": 5, "queue_depth": 2}])]) == Pong(5, 2, 0.0, 1.0)
    for message in (Pong(5, 2), Reply(7, "busy")):
        assert not any(field in wire.pack(message)[0] for field in (b"load", b"capacity"))


@pytest.mark.parametrize("field", ["load", "capacity"])
@pytest.mark.parametrize("share", [-0.01, 1.01, float("nan"), "1", True, None])
def test_what_is_no_share_of_a_cpu_is_refused(field: str, share: Any) -> None:
    """Times are multiplied and divided by it: a capacity of 0 is refused too."""
    for name, fields, rest in (("pong", {"id": 5, "queue_depth": 2}, []), ("reply", REPLY, [b"\xc0"])):
        assert wire.unpack([msgpack.packb([1, name, fields | {field: 1}]), *rest])
        for wrong in (share, 0) if field == "capacity" else (share,):
            with pytest.raises(ProtocolError, match=rf"{name}\.{field}"):
                wire.unpack([msgpack.packb([1, name, fields | {field: wrong}]), *rest])


@pytest.mark.parametrize("cpu_s", [-1e-9, float("nan"), float("inf"), 1e7, "1", True, None])
def test_a_wrong_cpu_time_is_refused(cpu_s: Any) -> None:
    """Left out or right: any other CPU time is a ProtocolError."""
    assert wire.unpack([msgpack.packb([1, "reply", REPLY | {"cpu_s": 0}]), b"\xc0"])
    with pytest.raises(ProtocolError, match=r"reply\.cpu_s"):
        wire.unpack([msgpack.packb([1, "reply", REPLY | {"cpu_s": cpu_s}]), b"\xc0"])


@pytest.mark.parametrize("header", [[2, "ping", {"id": 1}], [0], [2, {"all": "different"}, 1, 2]])
def test_another_version_is_told_apart(header: list[Any]) -> None:
    """Whatever follows another version number is a VersionMismatch."""
    with pytest.raises(wire.VersionMismatch, match=f"version {header[0]}"):
        wire.unpack([msgpack.packb(header)])


REQUEST = {"id": 1, "kind": "k", "budget_s": 1.0, "attempt": 1, "blobs": []}
REPLY = {"id": 1, "status": "ok", "error": "", "queue_s": 0.0, "run_s": 0.0, "queue_depth": 0, "missing": []}
REPLY |= {"server_fault": False}


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
    """A field that is out of range, mistyped or missing is a ProtocolError; the right one is taken."""
    assert wire.unpack([msgpack.packb([1, name, fields]), b"\xc0"])
    with pytest.raises(ProtocolError):
        wire.unpack([msgpack.packb([1, name, fields | wrong]), b"\xc0"])
    missing = {key: value for key, value in fields.items() if key not in wrong}
    with pytest.raises(ProtocolError):
        wire.unpack([msgpack.packb([1, name, missing]), b"\xc0"])


@pytest.mark.parametrize(
    "tasks", [{"": "h"}, {"n" * 65: "h"}, {"n": "h" * 129}, {1: "h"}, {str(n): "" for n in range(257)}]
)
def test_hello_bounds_its_tasks(tasks: dict[Any, str]) -> None:
    """Names, hashes and their number are bounded."""
    with pytest.raises(ProtocolError):
        wire.unpack([msgpack.packb([1, "hello", {"tasks": tasks, "software": "1"}])])


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
def test_frames_are_bounded(frames: list[bytes]) -> None:
    """Too many frames, too few, and a header over 64 KiB are ProtocolErrors."""
    with pytest.raises(ProtocolError):
        wire.unpack(frames)


def test_a_long_error_text_is_cut_when_packed() -> None:
    """An error of any length and with broken characters still makes a readable reply."""
    reply = wire.unpack(wire.pack(Reply(1, "failed", "\udc80" + "ä" * 10_000)))
    assert isinstance(reply, Reply)
    assert reply.error == "?" + "ä" * 1999


scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=20)
    | st.binary(max_size=40)
)
dtypes = (
    arrays.boolean_dtypes()
    | arrays.integer_dtypes(endianness="=")
    | arrays.unsigned_integer_dtypes(endianness=">")
    | arrays.floating_dtypes(sizes=(16, 32, 64), endianness="<")
    | arrays.complex_number_dtypes(sizes=(64, 128))
)
shaped = arrays.arrays(dtypes, arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
trees = st.recursive(
    scalars | shaped,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(max_size=5) | st.integers(-5, 2**40), inner, max_size=4)
        | st.builds(Pose, inner, inner, st.lists(inner, max_size=2))
    ),
    max_leaves=15,
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(trees)
def test_values_come_back_as_they_went(value: Any) -> None:
    """Every value that may cross comes back equal, arrays with the same dtype and shape."""
    body = wire.encode(value, [Pose])
    assert_same(wire.decode([bytes(frame) for frame in body.frames], [Pose], {}), value)


def assert_same(got: Any, wanted: Any) -> None:
    if isinstance(wanted, np.ndarray):
        assert got.dtype == wanted.dtype
        assert not got.flags.writeable
        np.testing.assert_array_equal(got, wanted)
    elif isinstance(wanted, Pose):
        assert_same([got.x, got.y, got.tags], [wanted.x, wanted.y, wanted.tags])
    elif isinstance(wanted, dict):
        assert list(got) == list(wanted)
        assert_same(list(got.values()), list(wanted.values()))
    elif isinstance(wanted, list | tuple):
        assert len(got) == len(wanted)
        for a, b in zip(got, wanted, strict=True):
            assert_same(a, b)
    else:
        assert type(got) is type(wanted)
        assert got == wanted


def test_tuples_and_numpy_scalars_become_lists_and_numbers() -> None:
    """What Python and numpy spell in several ways crosses in one."""
    got = wire.decode(wire.encode((np.float32(0.5), np.int8(-3), np.bool_(True), (1,))).frames, [], {})
    assert got == [0.5, -3, True, [1]]
    assert [type(item) for item in got] == [float, int, bool, list]


def test_arrays_are_not_copied() -> None:
    """A contiguous array's frame is its own memory, and a decoded one lies on the frame."""
    array = np.arange(1000.0)
    body = wire.encode(array)
    assert np.shares_memory(np.frombuffer(body.frames[1]), array)
    frame = bytes(body.frames[1])
    assert np.shares_memory(wire.decode([body.frames[0], frame], [], {}), np.frombuffer(frame))


def test_an_array_that_is_not_contiguous_crosses() -> None:
    """Order and steps in memory are not part of the value."""
    for array in (np.arange(12).reshape(3, 4).T, np.arange(10)[::-2], np.asfortranarray(np.eye(3))):
        got = wire.decode([bytes(f) for f in wire.encode(array).frames], [], {})
        np.testing.assert_array_equal(got, array)


class Plain:
    pass


@pytest.mark.parametrize(
    ("value", "named"),
    [
        (Plain(), "Plain"),
        ({1, 2}, "set"),
        (1 + 2j, "complex"),
        (Pose(1, 2, [Plain()]), "Plain"),
        (Positive(1), "Positive"),
        ({(1, 2): 3}, "tuple"),
        ({None: 3}, "NoneType"),
        (np.array([None]), "object"),
        (np.array(["a"]), "<U1"),
        (np.array(["2024-01-01"], "M8[D]"), "datetime64"),
        (np.zeros(2, "i4,i4"), "i4"),
        (np.ma.zeros(2), "MaskedArray"),
        (np.longdouble(1), "longdouble"),
        (np.zeros((1,) * 9), "9 dimensions"),
        (bytearray(3), "bytearray"),
        (2**64, "out of range"),
        ([np.zeros(1)] * 1001, "1000 arrays"),
        ("\ud800", "surrogates"),
    ],
)
def test_what_cannot_cross_is_named(value: Any, named: str) -> None:
    """One BadValue that says what is in the way, before anything is sent."""
    with pytest.raises(BadValue, match=named):
        wire.encode([value], [Pose])


def nested(levels: int) -> list[Any]:
    value: list[Any] = [b""]
    for _ in range(levels):
        value = [value]
    return value


def test_nesting_is_bounded_on_both_sides() -> None:
    """A value of the greatest depth crosses, one deeper does not."""
    deepest = nested(values.NESTING_MAX)
    assert wire.decode(wire.encode(deepest).frames, [], {}) == deepest
    with pytest.raises(BadValue, match="32 levels"):
        wire.encode([deepest])
    for levels in (values.NESTING_MAX + 2, 400, 5000):
        packed = b"\x91" * levels + b"\xc4\x00"
        with pytest.raises(ProtocolError):
            wire.decode([packed], [], {})
    circle: list[Any] = []
    circle.append(circle)
    with pytest.raises(BadValue, match="32 levels"):
        wire.encode(circle)


def place(*what: Any, code: int = 1) -> bytes:
    packed: bytes = msgpack.packb(msgpack.ExtType(code, msgpack.packb(what)))
    return packed


@pytest.mark.parametrize(
    "frames",
    [
        [place(1, "<f8", [2])],
        [place(0, "<f8", [1]), bytes(8)],
        [place(True, "<f8", [1]), bytes(8)],
        [place(1, "<f8", [2]), bytes(8)],
        [place(1, "<f8", [-1]), bytes(8)],
        [place(1, "<f8", [1.0]), bytes(8)],
        [place(1, "<f8", [2**63, 0]), b""],
        [place(1, "<f8", [2**62, 2**62, 0]), b""],
        [place(1, "|O", [1]), bytes(8)],
        [place(1, "O", [1]), bytes(8)],
        [place(1, "<U2", [1]), bytes(8)],
        [place(1, "<i4,<i4", [1]), bytes(8)],
        [place(1, ["<f8"], [1]), bytes(8)],
        [place(1, "<f8", [1] * 9), bytes(8)],
        [place(1, "<f8"), bytes(8)],
        [place(DIGEST, "<f8", [1], code=2)],
        [place([1], None, [], code=2)],
        [place("Pose", {"x": 1, "y": 2}, code=3)],
        [place("Pose", {"x": 1, "y": 2, "tags": [], "z": 0}, code=3)],
        [place("Pose", [1, 2, 3], code=3)],
        [place("Path", {}, code=3)],
        [place("Positive", {"value": -1}, code=3)],
        [place("Positive", {"value": "text"}, code=3)],
        [place(1, code=4)],
        [msgpack.packb(msgpack.Timestamp(0))],
        [msgpack.packb({1.5: 2})],
        [msgpack.packb({b"k": 2})],
        [b"\x81\x90\x01"],
        [b"\xdd\xff\xff\xff\xff"],
        [b"\xc0\xc0"],
        [b"\xa1\xff"],
        [b""],
        [],
    ],
)
def test_an_unsound_body_is_refused(frames: list[bytes]) -> None:
    """Frames that do not hold what they announce, dtypes and classes that are not allowed: ProtocolError."""
    with pytest.raises(ProtocolError):
        wire.decode(frames, [Pose, Positive], {})


def test_a_giant_announcement_allocates_nothing() -> None:
    """Nested arrays that announce items they do not hold are refused before they take memory."""
    claim = b"\xdd\x00\x00\xf0\x00" * 300 + bytes(65_000 - 1500)
    tracemalloc.start()
    with pytest.raises(ProtocolError):
        wire.unpack([claim])
    with pytest.raises(ProtocolError):
        wire.decode([claim], [], {})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2_000_000


def test_garbage_only_ever_raises_protocol_error() -> None:
    """Random frames, and valid messages with bytes changed, cut or swapped, never raise anything else."""
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
                wire.decode(message.body, [Pose, Positive], {})
        except ProtocolError:
            refused += 1
    assert 500 < refused < 3000


def mutate(chance: random.Random, frames: list[bytes]) -> None:
    at = chance.randrange(len(frames))
    frame = bytearray(frames[at])
    match chance.randrange(5):
        case 0:
            frames[at] = chance.randbytes(chance.randrange(200))
        case 1 if frame:
            frame[chance.randrange(len(frame))] = chance.randrange(256)
            frames[at] = bytes(frame)
        case 2:
            frames[at] = bytes(frame[: chance.randrange(len(frame) + 1)])
        case 3:
            frames.append(chance.randbytes(8))
        case _:
            chance.shuffle(frames)


def test_large_arguments_become_blobs() -> None:
    """Over 64 KiB, and only with blobs=True, arrays and bytes are named by the SHA-256 of their data."""
    array, text = np.arange(9000.0), b"t" * 70_000
    body = wire.encode([array, text, np.zeros(8192)], blobs=True)
    wanted = {hashlib.sha256(array.tobytes()).digest(): array.tobytes(), hashlib.sha256(text).digest(): text}
    assert {digest: bytes(data) for digest, data in body.blobs.items()} == wanted
    assert len(body.frames) == 2  # exactly 64 KiB is sent along
    stored = {digest: StoredBlob(data) for digest, data in body.blobs.items()}
    got = wire.decode(body.frames, [], stored)
    np.testing.assert_array_equal(got[0], array)
    assert got[1] == text
    assert wire.encode([array, text]).blobs == {}


def test_a_stored_blob_gives_the_same_array_again() -> None:
    """Identity is what the planner's cache goes by; another shape is another array, and views are bounded."""
    blob = StoredBlob(bytes(64))
    first = blob.array("<f8", (8,))
    assert blob.array("<f8", (8,)) is first
    assert blob.array("<f8", (2, 4)) is not first
    assert not first.flags.writeable
    for ndim in range(1, 9):
        blob.array("|u1", (64,) + (1,) * (ndim - 1))
    assert len(blob._views) == blobs.VIEWS_MAX
    with pytest.raises(ProtocolError):
        blob.array("<f8", (9,))


def test_the_store_forgets_the_least_recently_used() -> None:
    """Bytes stay within the bound; what was just asked for stays; an oversized blob is not kept."""
    store = BlobStore(100)
    a, b = store.add(b"a" * 40), store.add(b"b" * 40)
    kept = store.get(a)
    c = store.add(b"c" * 40)
    assert store.get(b) is None
    assert store.get(a) is kept
    assert store.get(c) is not None
    assert (len(store), store.byte_count) == (2, 80)
    assert store.add(b"a" * 40) == a
    assert store.get(a) is kept
    assert store.get(store.add(b"d" * 101)) is None
    assert store.byte_count == 80


def test_who_sends_many_blobs_pushes_out_his_own() -> None:
    """Of two owners the one with more bytes loses his oldest, and whatever was just sent stays."""
    store = BlobStore(100)
    grid = store.add(b"g" * 30, b"good")
    flood = [store.add(bytes([n]) * 30, b"greedy") for n in range(6)]
    assert store.get(grid) is not None
    assert [store.get(one) is not None for one in flood] == [False] * 4 + [True] * 2
    large = store.add(b"l" * 80, b"late")
    assert store.get(large) is not None
    assert store.byte_count == 80
    assert dict(store._owned) == {b"late": 80}


def test_the_hash_of_a_constant_array_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read-only arrays are hashed once while they live; writeable ones, and views of them, every time."""
    hashed: list[int] = []
    real = hashlib.sha256

    def counting(data: Any) -> Any:
        hashed.append(1)
        return real(data)

    monkeypatch.setattr(hashlib, "sha256", counting)
    constant, base = np.arange(10_000.0), np.arange(10_000.0)
    constant.flags.writeable = False
    view = base[:]
    view.flags.writeable = False
    counts = []
    for array in (constant, base, view):
        hashed.clear()
        digests = [next(iter(wire.encode(array, blobs=True).blobs)) for _ in range(3)]
        assert set(digests) == {real(array.tobytes()).digest()}
        counts.append(len(hashed))
    assert counts == [1, 3, 3]
    base[0] = 7
    assert next(iter(wire.encode(view, blobs=True).blobs)) == real(base.tobytes()).digest()


def test_the_hash_cache_lets_arrays_go() -> None:
    """A remembered hash does not outlive its array."""
    array = np.arange(10_000.0)
    array.flags.writeable = False
    wire.encode(array, blobs=True)
    key = id(array)
    assert key in blobs._digests
    del array
    assert key not in blobs._digests


def test_an_array_that_lies_askew_is_put_straight() -> None:
    """Compiled code sees aligned arrays only."""
    body = wire.encode(np.arange(5.0))
    askew = memoryview(b"x" + bytes(body.frames[1]))[1:]
    got = wire.decode([body.frames[0], askew], [], {})
    assert got.flags.aligned
    assert not got.flags.writeable
    np.testing.assert_array_equal(got, np.arange(5.0))


def test_messages_too_big_are_not_packed() -> None:
    """Our own bounds hold for what we send."""
    with pytest.raises(BadValue):
        wire.pack(Hello({f"task_{n:05}": "h" * 64 for n in range(1000)}, "1", 1))
