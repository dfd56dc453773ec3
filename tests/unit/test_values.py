"""Encoding and decoding values, and ProtocolError for malformed ones."""

import hashlib
import re
import tracemalloc
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from offboard.common.errors import BadValue, ProtocolError
from offboard.common.wire import messages as wire
from offboard.common.wire import values
from offboard.common.wire.compression import compress
from tests.wire_values import Pose

DIGEST = bytes(range(32))
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


def test_values_of_version_1_have_these_bytes() -> None:
    """Arrays, blobs and dataclasses have the extension codes 1, 2 and 3."""
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


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
@given(trees)
def test_decoding_reverses_encoding(value: Any) -> None:
    """Every allowed value comes back equal, arrays with the same dtype and shape."""
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


def compressed(*arrays: np.ndarray[Any, Any]) -> wire.Body:
    """The body of a call whose arrays are all sent compressed."""
    return wire.encode(list(arrays), blobs=True, along=lambda _, raw: compress(raw))


def test_a_compressed_array_has_the_extension_code_4() -> None:
    """It names its frame, dtype and shape as an array that is not compressed, and comes back equal."""
    array = np.arange(20_000).reshape(100, 200)
    body = compressed(array)
    assert bytes(body.frames[0]).hex() == "91" + "c70a04" + "9301a33c693892" + "64ccc8"
    assert len(body.frames[1]) < array.nbytes / 2
    assert_same(wire.decode([bytes(frame) for frame in body.frames], [], {}), [array])


def test_the_place_of_an_array_among_the_arguments_is_told() -> None:
    """Also if it is deep inside an argument, or becomes a blob."""
    seen = []

    def along(argument: int, raw: memoryview) -> memoryview | None:
        seen.append((argument, raw.nbytes))
        return raw if argument == 1 else None

    first, second, third = (np.full(10_000 + n, 0.5) for n in range(3))
    body = wire.encode([1, {"a": [second]}, "x", Pose(third, 0, [first])], [Pose], blobs=True, along=along)
    assert seen == [(1, second.nbytes), (3, third.nbytes), (3, first.nbytes)]
    assert list(body.arguments.values()) == [3, 3]
    assert body.arguments.keys() == body.blobs.keys()


def test_compressed_arrays_are_limited_together() -> None:
    """A few bytes cannot make the reader take more than DECOMPRESSED_BYTES_MAX of memory."""
    most = values.DECOMPRESSED_BYTES_MAX
    wire.decode(compressed(np.zeros(most // 2, np.uint8), np.ones(most // 2, np.uint8)).frames, [], {})
    bombs = [
        compressed(np.zeros(most + 1, np.uint8)),
        compressed(*(np.zeros(most // 4 + n, np.uint8) for n in range(4))),
    ]
    tracemalloc.start()
    for body in bombs:
        with pytest.raises(ProtocolError, match=f"compressed arrays of more than {most} bytes"):
            wire.decode(body.frames, [], {})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.5 * most


@pytest.mark.parametrize("shape", [[19_999], [20_001], [2**62], [2**40, 2**40], [0]])
def test_a_compressed_array_of_another_shape_is_refused(shape: list[int]) -> None:
    """The shape says how many bytes there must be."""
    body = compressed(np.arange(20_000))
    place = msgpack.ExtType(4, msgpack.packb((1, "<i8", shape)))
    with pytest.raises(ProtocolError):
        wire.decode([msgpack.packb([place]), body.frames[1]], [], {})


def test_tuples_and_numpy_scalars_become_lists_and_numbers() -> None:
    """After decoding they are plain Python values."""
    got = wire.decode(wire.encode((np.float32(0.5), np.int8(-3), np.bool_(True), (1,))).frames, [], {})
    assert got == [0.5, -3, True, [1]]
    assert [type(item) for item in got] == [float, int, bool, list]


def test_arrays_are_not_copied() -> None:
    """The frame of a contiguous array is its own memory, and a decoded array is a view of the frame."""
    array = np.arange(1000.0)
    body = wire.encode(array)
    assert np.shares_memory(np.frombuffer(body.frames[1]), array)
    frame = bytes(body.frames[1])
    assert np.shares_memory(wire.decode([body.frames[0], frame], [], {}), np.frombuffer(frame))


def test_arrays_that_are_not_contiguous_are_sent() -> None:
    """The memory layout of an array does not matter."""
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
        (Plain, "type"),
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
def test_a_value_that_cannot_be_sent_is_named(value: Any, named: str) -> None:
    """Encoding raises one BadValue that names it."""
    with pytest.raises(BadValue, match=named):
        wire.encode([value], [Pose])


class Index(int):
    """A key that looks like a number."""


@pytest.mark.parametrize(
    ("value", "place"),
    [
        ([0, {"pose": Pose(1, (2, 2**64), [])}], "[1]['pose'].y[1]: "),
        ({3: ["a", Pose(1, 2, ["\ud800"])]}, "[3][1].tags[0]: "),
        ([{"a": {Index(1): 2}}], "[0]['a']: "),
        ([np.zeros(3), [np.array([None])]], "[1][0]: "),
        ([[np.zeros(1)] * 600] * 2, ""),
        (Plain(), ""),
        ({"k" * 300: [{1}]}, f"['{'k' * 75}...: "),
    ],
)
def test_the_place_of_what_cannot_be_sent_is_named(value: Any, place: str) -> None:
    """It is the smallest part that cannot be sent by itself; a long place is cut."""
    with pytest.raises(BadValue) as caught:
        wire.encode(value, [Pose])
    said = str(caught.value)
    assert said.startswith(place)
    assert said.removeprefix(place).startswith(("a value of type", "the value", "a dict key", "an array"))
    with pytest.raises(BadValue) as caught:
        wire.encode(value, [Pose], name="result")
    assert str(caught.value).startswith(f"result{place}")


class Unshown:
    """A key whose text cannot be read."""

    def __repr__(self) -> str:
        raise SystemExit


def test_a_key_that_cannot_be_shown_is_no_place() -> None:
    """The error is that of the key."""
    with pytest.raises(BadValue, match=r"^\[0\]: a dict key of type Unshown cannot be sent"):
        wire.encode([{Unshown(): {1}}], [Pose])


def nested(levels: int) -> list[Any]:
    value: list[Any] = [b""]
    for _ in range(levels):
        value = [value]
    return value


def test_nesting_is_limited_on_both_sides() -> None:
    """A value of the greatest depth is sent; a deeper one is refused, by the sender and by the reader."""
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


@pytest.mark.parametrize("count", [1, 10])
def test_a_dataclass_counts_as_several_levels(count: int) -> None:
    """With DATACLASS_LEVELS for each, the deepest value is sent, and one level more is refused."""

    def within(value: Any) -> Any:
        for _ in range(count):
            value = Pose(value, 0, [])
        return value

    left = values.NESTING_MAX - count * values.DATACLASS_LEVELS
    deepest = within(nested(left))
    assert wire.decode(wire.encode(deepest, [Pose]).frames, [Pose], {}) == deepest
    with pytest.raises(BadValue, match="32 levels"):
        wire.encode(within(nested(left + 1)), [Pose])


@pytest.mark.parametrize("code", np.typecodes["AllInteger"] + np.typecodes["AllFloat"] + "?")
@pytest.mark.parametrize("order", "<>")
def test_numbers_of_up_to_8_bytes_are_sent(code: str, order: str) -> None:
    """Arrays of each type are, and complex numbers of 16 bytes; `longdouble` and `clongdouble` are not."""
    dtype = np.dtype(code).newbyteorder(order)
    if dtype.itemsize <= 8 * (1 + (dtype.kind == "c")):
        array = np.arange(3).astype(dtype)
        got = wire.decode(wire.encode(array).frames, [], {})
        assert (got.dtype, got.tolist()) == (dtype, array.tolist())
    else:
        assert code in "gG"
        with pytest.raises(BadValue, match=f"dtype {re.escape(str(dtype))} cannot be sent"):
            wire.encode(np.zeros(3, dtype))


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
def test_a_malformed_body_is_refused(frames: list[bytes]) -> None:
    """Wrong references, sizes, dtypes and classes are ProtocolErrors."""
    with pytest.raises(ProtocolError):
        wire.decode(frames, [Pose], {})


def test_a_huge_announcement_allocates_little() -> None:
    """Nested lists that announce more items than they hold are refused before memory is allocated."""
    claim = b"\xdd\x00\x00\xf0\x00" * 300 + bytes(65_000 - 1500)
    tracemalloc.start()
    with pytest.raises(ProtocolError):
        wire.unpack([claim])
    with pytest.raises(ProtocolError):
        wire.decode([claim], [], {})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2_000_000


def test_an_unaligned_array_is_copied() -> None:
    """Tasks get aligned arrays only, so that numba does not compile kernels again."""
    body = wire.encode(np.arange(5.0))
    askew = memoryview(b"x" + bytes(body.frames[1]))[1:]
    got = wire.decode([body.frames[0], askew], [], {})
    assert got.flags.aligned
    assert not got.flags.writeable
    np.testing.assert_array_equal(got, np.arange(5.0))
