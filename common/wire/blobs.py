"""Blobs, which are large arguments named by their SHA-256: digests, a bounded store, and array views."""

import hashlib
import math
import weakref
from collections import Counter, OrderedDict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.errors import ProtocolError

Buffer = bytes | memoryview
Array = NDArray[Any]

VIEWS_MAX = 8  # arrays of different shapes or types that are kept for one blob

_CODES = ("b1", "i1", "u1", "i2", "u2", "f2", "i4", "u4", "f4", "i8", "u8", "f8", "c8", "c16")
DTYPES = {np.dtype(order + code).str: np.dtype(order + code) for code in _CODES for order in "<>"}


class StoredBlob:
    """The bytes of one blob. Asked for the same dtype and shape, it returns the same array object."""

    def __init__(self, data: Buffer) -> None:
        self.data = memoryview(data).toreadonly()
        self._views: OrderedDict[tuple[str, tuple[int, ...]], Array] = OrderedDict()

    def array(self, dtype: str, shape: tuple[int, ...]) -> Array:
        view = self._views.get((dtype, shape))
        if view is None:
            view = self._views[dtype, shape] = array_view(self.data, dtype, shape)
            if len(self._views) > VIEWS_MAX:
                self._views.popitem(last=False)
        return view


class BlobStore:
    """At most `bytes_max` of blobs, by their SHA-256. For one thread at a time.

    If there is no room, the owner with the most bytes loses its least recently used blob. A robot that sends
    many blobs therefore does not push out the blobs of others.
    """

    def __init__(self, bytes_max: int) -> None:
        self.bytes_max = bytes_max
        self.byte_count = 0
        self._blobs: OrderedDict[bytes, StoredBlob] = OrderedDict()
        self._owners: dict[bytes, bytes] = {}
        self._owned: Counter[bytes] = Counter()

    def add(self, data: Buffer, owner: bytes = b"") -> bytes:
        """Keep `data` and return its digest. Data larger than the whole store is not kept."""
        digest = hashlib.sha256(data).digest()
        if digest in self._blobs:
            self._blobs.move_to_end(digest)
        elif byte_length(data) <= self.bytes_max:
            self._blobs[digest] = StoredBlob(data)
            self._owners[digest] = owner
            self._owned[owner] += byte_length(data)
            self.byte_count += byte_length(data)
        while self.byte_count > self.bytes_max:
            owned = self._owned - Counter({owner: byte_length(data)})  # this blob does not count
            heaviest = max(owned, key=owned.__getitem__)
            self._drop(next(one for one in self._blobs if self._owners[one] == heaviest and one != digest))
        return digest

    def _drop(self, digest: bytes) -> None:
        count, owner = self._blobs.pop(digest).data.nbytes, self._owners.pop(digest)
        self.byte_count -= count
        self._owned[owner] -= count
        if not self._owned[owner]:
            del self._owned[owner]

    def get(self, digest: bytes) -> StoredBlob | None:
        blob = self._blobs.get(digest)
        if blob is not None:
            self._blobs.move_to_end(digest)
        return blob

    def __len__(self) -> int:
        return len(self._blobs)

    def bytes_of(self, owner: bytes) -> int:
        return self._owned[owner]


_digests: dict[int, tuple[weakref.ref[Array], bytes]] = {}


def array_digest(array: Array, raw: memoryview) -> bytes:
    """SHA-256 of the data of an array. If nothing can ever change the array, it is computed once."""
    if not _constant(array):
        return hashlib.sha256(raw).digest()
    key = id(array)
    known = _digests.get(key)
    if known is not None and known[0]() is array:
        return known[1]
    digest = hashlib.sha256(raw).digest()
    _digests[key] = (weakref.ref(array, lambda _: _digests.pop(key, None)), digest)
    return digest


def _constant(array: Array) -> bool:
    """Whether the memory is that of a `bytes`. Any other array can be unlocked, or have a writeable view."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return isinstance(base, bytes)


def array_view(data: memoryview, dtype: Any, shape: tuple[int, ...]) -> Array:
    """A read-only array on `data`. It is copied only if the data is not aligned."""
    kind = checked_dtype(dtype)
    if math.prod(shape) * kind.itemsize != data.nbytes:
        raise ProtocolError(f"an array of shape {shape} and dtype {kind} does not have {data.nbytes} bytes")
    try:
        array: Array = np.ndarray(shape, kind, buffer=data.toreadonly())
    except (ValueError, TypeError, OverflowError) as error:
        raise ProtocolError(f"an array of shape {shape}: {error}") from error
    if not array.flags.aligned:  # numba would compile kernels again for such an array
        array = array.copy()
        array.flags.writeable = False
    return array


def checked_dtype(name: Any) -> np.dtype[Any]:
    if not isinstance(name, str) or name not in DTYPES:
        raise ProtocolError(f"an array of dtype {name!r:.80} is not allowed")
    return DTYPES[name]


def byte_length(data: Buffer) -> int:
    return data.nbytes if isinstance(data, memoryview) else len(data)
