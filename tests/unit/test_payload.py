"""The bytes of a value, counted without encoding it."""

import math
import tracemalloc
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from offboard.common.wire.payload import LOOKS_MAX, NUMBER_BYTES, payload_bytes
from offboard.common.wire.values import BLOB_BYTES_MIN, encode
from tests.crossing_tasks import UNSENDABLE
from tests.wire_values import Pose

LARGE = BLOB_BYTES_MIN + 1000


@dataclass(frozen=True)
class Path:
    """A dataclass of dataclasses, with a field that its `__init__` does not take."""

    poses: list[Pose]
    name: str = ""
    cache: bytes = field(default=b"x" * 50_000, init=False)


TYPES = (Pose, Path)


def true_bytes(value: Any) -> int:
    """The bytes of the frames that the wire format makes of a value."""
    return sum(memoryview(frame).nbytes for frame in encode(value, TYPES).frames)


@pytest.mark.parametrize(
    "value",
    [
        np.zeros((480, 640, 3), np.uint8),
        np.zeros((1000, 3), np.float32)[:, :2],
        [np.ones(200) for _ in range(50)],
        b"x" * 5000,
        "scan " * 1000,
        [1.5] * 360,
        [1.5] * 100_000,
        [[0.5] * 300 for _ in range(300)],
        {"scan": [1.5] * 360, "image": b"x" * 5000},
        [{"name": "a longer name of a tag " * 4, "corners": [1.0] * 80} for _ in range(100)],
        [1.5, 2.5, "a longer name of a tag " * 4] * 1000,
        Path([Pose(0.5, 1.5, [0.5] * 100) for _ in range(100)], "home"),
    ],
    ids=lambda one: f"{type(one).__name__} {str(one)[:12]!r}",
)
def test_arrays_texts_and_floats_are_counted_to_10_percent(value: Any) -> None:
    """They are counted so alone, in lists of up to 100,000 items, and in nested dataclasses."""
    assert payload_bytes(value) == pytest.approx(true_bytes(value), rel=0.1)


@pytest.mark.parametrize("number", [0, -300, 2**60, True, None, np.int16(5), np.float64(0.5)])
def test_every_number_counts_as_much_as_a_float(number: Any) -> None:
    """Also a small integer, which is sent in fewer bytes."""
    assert payload_bytes(number) == NUMBER_BYTES
    assert payload_bytes([number] * 5000) == 5000 * NUMBER_BYTES


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
    assert payload_bytes([image, {"scan": scan}, tag, b"abc"], have) == len("scan") + LARGE + 20 + 3
    assert have.asked == [LARGE, LARGE, LARGE]
    both = Asked(image.tobytes(), scan)
    assert payload_bytes([image, {"scan": scan}], both) == len("scan")


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


@pytest.mark.parametrize(
    "shape", [(1_000_000,), (1999,), (1000, 1000), (600, 1999), (100, 100, 100), (3,) * 12]
)
def test_of_long_lists_only_some_items_are_looked_at(shape: tuple[int, ...]) -> None:
    """Of one list and of lists in lists, at most LOOKS_MAX items are looked at, and all of them count."""
    one = Counted()
    Counted.looked = 0
    payload_bytes(one)
    each, value = Counted.looked, one
    for count in shape:
        value = [value] * count
    Counted.looked = 0
    found = payload_bytes(value)
    assert 0 < Counted.looked <= LOOKS_MAX * each
    assert found == math.prod(shape) * NUMBER_BYTES


def test_what_cannot_be_sent_is_counted_too() -> None:
    """An unknown object and a list that contains itself give a number; sending them gives the error."""
    endless: list[Any] = []
    endless += [endless, endless]
    assert payload_bytes(endless) > 0
    assert payload_bytes([object(), {1, 2}]) > 0


@pytest.mark.parametrize("name", UNSENDABLE)
def test_no_value_breaks_the_count(name: str) -> None:
    """It is counted before the site is chosen, so an error would reach the caller."""
    value = UNSENDABLE[name][0]()
    assert payload_bytes([value, value], Asked()) > 0
