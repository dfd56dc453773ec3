"""The bytes of a value, counted without encoding it."""

import tracemalloc
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from offboard.common.wire import payload
from offboard.common.wire.payload import payload_bytes
from offboard.common.wire.values import ARRAYS_MAX, BLOB_BYTES_MIN, encode
from tests.wire_values import Pose

LARGE = BLOB_BYTES_MIN + 1000


@dataclass(frozen=True)
class Path:
    """A dataclass of dataclasses, with a field that is not sent."""

    poses: list[Pose]
    name: str = ""
    cache: bytes = field(default=b"x" * 5000, init=False)


TYPES = (Pose, Path)


def true_bytes(value: Any) -> int:
    """The bytes of the frames that the wire format makes of a value."""
    return sum(memoryview(frame).nbytes for frame in encode(value, TYPES).frames)


def assert_right(value: Any) -> None:
    assert payload_bytes(value) == pytest.approx(true_bytes(value), rel=0.1)


POSES = [Pose(n / 7, -n / 3, ["tag", n]) for n in range(100)]


@pytest.mark.parametrize(
    "value",
    [
        np.zeros((480, 640, 3), np.uint8),
        np.zeros((1000, 3), np.float32)[:, :2],
        [np.ones(3) for _ in range(200)],
        b"x" * 5000,
        "scan " * 1000,
        "Straße 端 " * 1000,
        [1.5] * 360,
        [True, None] * 1000,
        list(range(100_000)),
        list(range(-50_000, 0)),
        [[0] * 300 for _ in range(300)],
        [7, 1.5, "a longer name of a tag"] * 1000,
        [{"id": n, "corners": [1.0] * 8, "name": "tag"} for n in range(100)],
        {str(n): n for n in range(500)},
        POSES,
        Path(POSES, "home"),
        [Path(POSES[:n]) for n in range(20)],
        (np.float64(1.0), [np.int16(5)] * 2000),
    ],
    ids=lambda one: f"{type(one).__name__} {str(one)[:12]!r}",
)
def test_usual_values_are_counted_to_10_percent(value: Any) -> None:
    """Arrays, texts, lists of up to 100,000 items and nested dataclasses take about the true bytes."""
    assert true_bytes(value) > 1000
    assert_right(value)


scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.integers(-300, 300)
    | st.floats(allow_nan=False)
    | st.text(max_size=50)
    | st.binary(max_size=300)
)
shaped = arrays.arrays(
    arrays.integer_dtypes() | arrays.floating_dtypes(sizes=(32, 64)),
    arrays.array_shapes(min_dims=1, max_dims=3, min_side=1, max_side=6),
)
trees = st.recursive(
    scalars | shaped,
    lambda inner: (
        st.lists(inner, max_size=6)
        | st.dictionaries(st.text(max_size=8) | st.integers(-5, 2**40), inner, max_size=6)
        | st.builds(Pose, inner, st.floats(), st.lists(inner, max_size=3))
    ),
    max_leaves=15,
)


@settings(deadline=None)  # the first array loads parts of numpy
@given(value=st.lists(trees, min_size=1, max_size=8), times=st.integers(1, 50))
def test_any_value_above_1_kb_is_counted_to_10_percent(value: list[Any], times: int) -> None:
    """This holds for any tree of values that the wire format knows."""
    many = value * times
    assume(len(encode(value, TYPES).frames) * times < ARRAYS_MAX)
    assume(true_bytes(many) > 1000)
    assert_right(many)


class Asked:
    """The blobs that the other side has; remembers what it was asked for."""

    def __init__(self, *known: bytes) -> None:
        self.known = known
        self.asked: list[int] = []

    def __call__(self, raw: memoryview) -> bool:
        self.asked.append(raw.nbytes)
        return bytes(raw) in self.known


def test_known_blobs_count_as_nothing() -> None:
    """Only large arrays and bytes are asked for, each once; what is not known counts as a whole."""
    image, scan, tag = np.ones(LARGE, np.uint8), b"s" * LARGE, np.ones(20, np.uint8)
    have = Asked(image.tobytes(), tag.tobytes(), b"abc")
    assert payload_bytes(image, have) == 0
    assert payload_bytes([image, {"scan": scan}, tag, b"abc"], have) == pytest.approx(LARGE + 50, abs=20)
    assert have.asked == [LARGE, LARGE, LARGE]
    both = Asked(image.tobytes(), scan)
    assert payload_bytes([image, {"scan": scan}], both) < 20


def test_an_array_is_neither_read_nor_copied() -> None:
    """Counting 800 MB of virtual memory, also as a slice with gaps, allocates almost nothing."""
    huge = np.zeros(100_000_000)
    tracemalloc.start()
    assert payload_bytes((huge, huge[::2])) == pytest.approx(1.5 * huge.nbytes)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100_000


class Counted:
    """An item that counts how often its class is asked for, as `isinstance` does."""

    looked = 0

    @property  # type: ignore[misc]
    def __class__(self) -> type:
        Counted.looked += 1
        return Counted


def test_of_a_long_list_only_some_items_are_looked_at() -> None:
    """Of a million items, and of a list of lists with as many, at most ITEMS_MAX are looked at."""
    one = Counted()
    one.__class__  # noqa: B018 - one look
    payload_bytes([one])
    each = Counted.looked - 1
    for value in ([one] * 1_000_000, [[one] * 1000] * 1000, [[[one] * 100] * 100] * 100):
        Counted.looked = 0
        payload_bytes(value)
        assert 0 < Counted.looked <= payload.ITEMS_MAX * each, len(value)


def test_what_cannot_be_sent_is_counted_too() -> None:
    """An unknown object and a list that contains itself give a number; sending them gives the error."""
    endless: list[Any] = []
    endless += [endless, endless]
    assert payload_bytes(endless) > 0
    assert payload_bytes([object(), {1, 2}]) > 0
