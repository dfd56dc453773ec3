"""Blobs: naming large arguments, hashing them once, and the bounded store."""

import hashlib
import weakref
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import ProtocolError
from offboard.common.wire import blobs
from offboard.common.wire import messages as wire
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


def test_the_hash_of_a_constant_array_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A read-only array is hashed once; a writeable array, or a view of one, is hashed each time."""
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


def test_the_hash_cache_does_not_keep_arrays_alive() -> None:
    """An array is freed although its hash was cached, and a new array is hashed anew."""
    array = np.arange(10_000.0)
    array.flags.writeable = False
    wire.encode(array, blobs=True)
    gone = weakref.ref(array)
    del array
    assert gone() is None
    for n in range(20):  # some of these arrays get the id of an earlier one
        fresh = np.full(10_000, float(n))
        fresh.flags.writeable = False
        digest = hashlib.sha256(fresh.tobytes()).digest()
        assert list(wire.encode(fresh, blobs=True).blobs) == [digest]
