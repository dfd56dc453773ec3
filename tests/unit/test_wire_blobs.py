"""Blobs: naming large arguments, hashing them once, and the bounded store."""

import hashlib
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import ProtocolError
from offboard.common.planning.maps import GridMap
from offboard.common.wire import blobs
from offboard.common.wire import messages as wire
from offboard.common.wire.blobs import Array
from offboard.common.wire.messages import BlobStore, StoredBlob


def test_large_arguments_become_blobs() -> None:
    """With blobs=True, arrays and bytes above 64 KiB are named by the SHA-256 of their data."""
    array, text = np.arange(9000.0), b"t" * 70_000
    body = wire.encode([array, text, np.zeros(8192)], blobs=True)
    wanted = {hashlib.sha256(array.tobytes()).digest(): array.tobytes(), hashlib.sha256(text).digest(): text}
    assert {digest: bytes(data) for digest, data in body.blobs.items()} == wanted
    assert len(body.frames) == 2  # an array of exactly 64 KiB is sent in a frame
    stored = {digest: StoredBlob(data) for digest, data in body.blobs.items()}
    got = wire.decode(body.frames, [], stored)
    np.testing.assert_array_equal(got[0], array)
    assert got[1] == text
    assert wire.encode([array, text]).blobs == {}


def test_a_stored_blob_returns_the_same_array() -> None:
    """The planner recognises maps by identity. Another shape is another array, and few views are kept."""
    blob = StoredBlob(bytes(64))
    first = blob.array("<f8", (8,))
    assert blob.array("<f8", (8,)) is first
    assert blob.array("<f8", (2, 4)) is not first
    assert not first.flags.writeable
    for ndim in range(1, blobs.VIEWS_MAX + 1):
        blob.array("|u1", (64,) + (1,) * (ndim - 1))
    assert blob.array("<f8", (8,)) is not first
    with pytest.raises(ProtocolError):
        blob.array("<f8", (9,))


def test_the_store_drops_the_least_recently_used() -> None:
    """The bytes stay within the limit, recently used blobs stay, and a blob above the limit is not kept."""
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


def test_an_owner_with_many_blobs_loses_its_own() -> None:
    """The owner with the most bytes loses its oldest blob; a blob that was just added stays."""
    store = BlobStore(100)
    grid = store.add(b"g" * 30, b"good")
    flood = [store.add(bytes([n]) * 30, b"greedy") for n in range(6)]
    assert store.get(grid) is not None
    assert [store.get(one) is not None for one in flood] == [False] * 4 + [True] * 2
    large = store.add(b"l" * 80, b"late")
    assert store.get(large) is not None
    assert store.byte_count == 80
    assert [store.bytes_of(owner) for owner in (b"good", b"greedy", b"late")] == [0, 0, 80]


def digest_of(array: Array) -> bytes:
    """The name that an array gets as a blob."""
    return next(iter(wire.encode(array, blobs=True).blobs))


def frozen(array: Array) -> Array:
    array.flags.writeable = False
    return array


def constant(value: float = 1.0) -> Array:
    """An array on `bytes`, which nothing can change."""
    return np.frombuffer(np.full(10_000, value).tobytes()).reshape(100, 100)


def unlocked(base: Array) -> tuple[Array, Array]:
    return frozen(base), base


def older_view(base: Array) -> tuple[Array, Array]:
    view = base[:]
    return frozen(base), view


def younger_view(base: Array) -> tuple[Array, Array]:
    return frozen(base[:]), base


def view_of_a_locked_owner(base: Array) -> tuple[Array, Array]:
    return frozen(base)[:], base


def buffer(base: Array) -> tuple[Array, Array]:
    data = bytearray(base.tobytes())
    return frozen(np.frombuffer(data)), np.frombuffer(data)


def read_only_view_of_a_buffer(base: Array) -> tuple[Array, Array]:
    data = bytearray(base.tobytes())
    return np.frombuffer(memoryview(data).toreadonly()), np.frombuffer(data)


WAYS = (unlocked, older_view, younger_view, view_of_a_locked_owner, buffer, read_only_view_of_a_buffer)


@pytest.mark.parametrize("way", WAYS)
def test_a_read_only_array_that_changed_gets_another_name(
    way: Callable[[Array], tuple[Array, Array]],
) -> None:
    """The array is locked when it is sent, both times, and its memory is changed in between."""
    sent, same_memory = way(np.zeros(10_000))
    assert np.shares_memory(sent, same_memory)
    for value in (0.0, 7.0, 8.0):
        if not same_memory.flags.writeable:
            same_memory.flags.writeable = True
        same_memory[:] = value
        assert digest_of(frozen(sent)) == hashlib.sha256(np.full(10_000, value).tobytes()).digest()


def test_only_an_array_on_bytes_is_hashed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing can change such an array, or a view of it. Every other array is hashed at each call."""
    hashed: list[int] = []
    real = hashlib.sha256

    def counting(data: Any) -> Any:
        hashed.append(1)
        return real(data)

    monkeypatch.setattr(hashlib, "sha256", counting)
    of_a_map = GridMap(np.zeros((300, 300), np.int8), 0.05).cells
    counts = []
    for array in (constant(), constant()[:90], of_a_map, np.zeros(10_000), frozen(np.zeros(10_000))):
        hashed.clear()
        assert {digest_of(array) for _ in range(3)} == {real(array.tobytes()).digest()}
        counts.append(len(hashed))
    assert counts == [1, 1, 1, 3, 3]


def test_the_hash_cache_does_not_keep_arrays_alive() -> None:
    """An array is freed although its hash was cached, and a new array is hashed anew."""
    array = constant()
    digest_of(array)
    gone = weakref.ref(array)
    del array
    assert gone() is None
    for n in range(20):  # some of these arrays get the id of an earlier one
        fresh = constant(float(n))
        assert digest_of(fresh) == hashlib.sha256(fresh.tobytes()).digest()
