"""The limit of the items of a value: counted before they are made, and alike on both sides."""

import tracemalloc
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from offboard.common.errors import BadValue, ProtocolError
from offboard.common.wire import item_count, values
from offboard.common.wire import messages as wire
from offboard.common.wire.item_count import ITEMS_MAX, count_items
from offboard.robot_client.policy_servers import openpi
from tests.wire_values import Pose

SAID = f"more than {ITEMS_MAX} items"
FEW = 10_000  # a limit with which tests are fast
ITEM_BYTES = 130  # of memory that an item takes while it is read, at most
CODE = 3  # of a dataclass among the extensions of msgpack
scalars = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.sampled_from([0, 31, 32, 255, 256, 65_535, 65_536]).map("x".__mul__)
    | st.sampled_from([0, 255, 256, 65_535, 65_536]).map(bytes)
    | st.sampled_from([1, 2, 3, 4, 8, 15, 16, 255, 256, 65_536]).map(
        lambda size: msgpack.ExtType(7, bytes(size))
    )
)
keys = st.text(max_size=40) | st.integers(-(2**63), 2**64 - 1)
trees = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=4)
        | inner.map(lambda one: [one] * 16)
        | st.dictionaries(keys, inner, max_size=20)
    ),
    max_leaves=10,
)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Sets the limit."""

    def limit(items_max: int) -> None:
        for module in (item_count, values):
            monkeypatch.setattr(module, "ITEMS_MAX", items_max)

    limit(FEW)
    return limit


def items(tree: Any) -> int:
    """How many items a tree has, by walking it."""
    if isinstance(tree, dict):
        return 1 + sum(1 + items(one) for one in tree.values())
    if isinstance(tree, list):
        return 1 + sum(map(items, tree))
    return 1


@settings(max_examples=50)
@given(trees)
def test_the_items_of_a_message_are_counted_as_msgpack_makes_them(tree: Any) -> None:
    """Each scalar, key, list and map is one, in each of the forms that msgpack has for it."""
    assert count_items(msgpack.packb(tree), ITEMS_MAX) == items(tree)


@pytest.mark.parametrize("count", [65_535, 65_536])
def test_long_lists_and_maps_are_counted(count: int) -> None:
    """Their headers have other forms than those of short ones."""
    assert count_items(msgpack.packb([0] * count), ITEMS_MAX) == count + 1
    assert count_items(msgpack.packb(dict.fromkeys(range(count))), ITEMS_MAX) == 2 * count + 1


@given(st.binary(max_size=300), st.integers(0, 300))
def test_any_bytes_are_counted(data: bytes, most: int) -> None:
    """Also those that are cut short; the count exceeds neither the bytes, nor `most` by more than one."""
    assert count_items(data, most) <= min(len(data), most + 1)


LARGEST = [
    pytest.param(lambda more: [0.5] * (FEW - 1 + more), id="numbers"),
    pytest.param(lambda more: [[1, "x"]] * (FEW // 3 - 1) + [[1.0] * (2 + more)], id="lists"),
    pytest.param(lambda more: [dict.fromkeys(range(FEW // 2 - 1)), *["x"] * more], id="keys"),
    pytest.param(lambda more: [Pose(0, 0, []), [0.5] * (FEW - 12 + more)], id="a dataclass"),
    pytest.param(lambda more: Pose(0, 0, [0.5] * (FEW - 10 + more)), id="in a dataclass"),
    pytest.param(lambda more: [np.zeros(2), b"xx"] + [0.5] * (FEW - 3 + more), id="an array"),
]


@pytest.mark.parametrize("make", LARGEST)
def test_both_sides_allow_as_many_items(make: Callable[[int], Any], few: Callable[[int], None]) -> None:
    """A value with as many items as allowed is sent and read; the sender and the reader refuse one more."""
    frames = wire.encode(make(0), [Pose]).frames
    assert len(bytes(frames[0])) > FEW
    wire.decode(frames, [Pose], {})
    with pytest.raises(BadValue, match=f"^result has {SAID}.*; make an array of a longer list of numbers"):
        wire.encode(make(1), [Pose], name="result")
    few(FEW + 1)
    frames = wire.encode(make(1), [Pose]).frames
    few(FEW)
    with pytest.raises(ProtocolError, match=f"^the value has {SAID}"):
        wire.decode(frames, [Pose], {})


def test_a_list_that_is_too_long_is_refused_before_its_items_are_looked_at(
    few: Callable[[int], None],  # noqa: ARG001
) -> None:
    """Otherwise the sender would take seconds for it."""
    seen: list[int] = []

    class Watched(list[int]):
        def __iter__(self) -> Any:
            seen.append(len(self))
            return super().__iter__()

    with pytest.raises(BadValue, match=SAID):
        wire.encode([[0] * FEW, {"a": Watched([1])}])
    assert not seen


def listed(items: bytes, count: int) -> bytes:
    return b"\xdd" + count.to_bytes(4, "big") + items


def of_dataclasses() -> bytes:
    """Fifty dataclasses that are each just small enough."""
    one = ["Pose", {"x": 0, "y": 0, "tags": [[]] * (FEW - 20)}]
    return bytes(msgpack.packb([msgpack.ExtType(CODE, msgpack.packb(one))] * 50))


MANY_LISTS = listed(b"\x90" * 50 * FEW, 50 * FEW)
BOMBS = [
    pytest.param(MANY_LISTS, id="a list of lists"),
    pytest.param(listed(b"\x80" * 50 * FEW, 50 * FEW), id="a list of dicts"),
    pytest.param(listed(bytes(FEW - 2), FEW - 1) * 50 + b"\0", id="each list the last item of another"),
    pytest.param(b"\x91" * 100 + MANY_LISTS, id="far inside"),
    pytest.param(bytes(msgpack.packb(msgpack.ExtType(1, MANY_LISTS))), id="in the place of an array"),
    pytest.param(of_dataclasses(), id="in dataclasses"),
]


def peak_of(call: Callable[[], Any]) -> int:
    """The memory that a call takes which raises ProtocolError."""
    tracemalloc.start()
    try:
        with pytest.raises(ProtocolError):
            call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("data", BOMBS)
def test_too_many_items_cost_the_reader_no_memory(
    data: bytes,
    few: Callable[[int], None],  # noqa: ARG001
) -> None:
    """They are refused before they are made, wherever in the message they are."""
    allowed = ITEM_BYTES * FEW + 4 * len(data)
    assert peak_of(lambda: wire.decode([data], [Pose], {})) < allowed


def test_an_answer_of_a_policy_server_has_as_many_items_at_most(
    few: Callable[[int], None],  # noqa: ARG001
) -> None:
    """One with more is malformed, and costs no memory; an observation with more is not sent."""
    largest = [1.5] * (FEW - 1)
    assert openpi.unpack(openpi.pack(largest)) == largest
    with pytest.raises(BadValue, match=f"^it has {SAID}"):
        openpi.pack([*largest, []])
    assert peak_of(lambda: openpi.unpack(MANY_LISTS)) < len(MANY_LISTS)
