"""Large arguments named by their SHA-256: digests, a byte-bounded store, and array views on raw bytes.

Which values become blobs is decided in `common.values`.
"""

import hashlib
import math
import weakref
from collections import OrderedDict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.errors import ProtocolError

Buffer = bytes | memoryview
Array = NDArray[Any]

VIEWS_MAX = 8  # differently shaped arrays kept of one blob

_CODES = ("b1", "i1", "u1", "i2", "u2", "f2", "i4", "u4", "f4", "i8", "u8", "f8", "c8", "c16")
DTYPES = {np.dtype(order + code).str: np.dtype(order + code) for code in _CODES for order in "<>"}


class StoredBlob:
    """The bytes of one blob; the same (dtype, shape) gives the same array object while the blob lives."""

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
    """Blobs by SHA-256, least recently used out first beyond `bytes_max`. For one thread."""

    def __init__(self, bytes_max: int) -> None:
        self.bytes_max = bytes_max
        self.byte_count = 0
        self._blobs: OrderedDict[bytes, StoredBlob] = OrderedDict()

    def add(self, data: Buffer) -> bytes:
        """Keep `data` and return its digest; data larger than the whole store is not kept."""
        digest = hashlib.sha256(data).digest()
        if digest in self._blobs:
            self._blobs.move_to_end(digest)
        elif byte_length(data) <= self.bytes_max:
            self._blobs[digest] = StoredBlob(data)
            self.byte_count += byte_length(data)
        while self.byte_count > self.bytes_max:
            _, oldest = self._blobs.popitem(last=False)
            self.byte_count -= oldest.data.nbytes
        return digest

    def get(self, digest: bytes) -> StoredBlob | None:
        blob = self._blobs.get(digest)
        if blob is not None:
            self._blobs.move_to_end(digest)
        return blob

    def __len__(self) -> int:
        return len(self._blobs)


_digests: dict[int, tuple[weakref.ref[Array], bytes]] = {}


def array_digest(array: Array, raw: memoryview) -> bytes:
    """SHA-256 of the array's data; remembered by identity where nobody can write to it."""
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
    """Neither the array nor what it is a view of can be written to."""
    base: Any = array
    while isinstance(base, np.ndarray):
        if base.flags.writeable:
            return False
        base = base.base
    return base is None or isinstance(base, bytes)


def array_view(data: memoryview, dtype: Any, shape: tuple[int, ...]) -> Array:
    """A read-only array on `data`, not copied unless it lies askew."""
    kind = checked_dtype(dtype)
    if math.prod(shape) * kind.itemsize != data.nbytes:
        raise ProtocolError(f"array of shape {shape} and dtype {kind} does not fill {data.nbytes} bytes")
    try:
        array: Array = np.ndarray(shape, kind, buffer=data.toreadonly())
    except (ValueError, TypeError, OverflowError) as error:
        raise ProtocolError(f"array of shape {shape}: {error}") from error
    if not array.flags.aligned:  # compiled code would be compiled again for it
        array = array.copy()
        array.flags.writeable = False
    return array


def checked_dtype(name: Any) -> np.dtype[Any]:
    if not isinstance(name, str) or name not in DTYPES:
        raise ProtocolError(f"array of dtype {name!r:.80} is not allowed")
    return DTYPES[name]


def byte_length(data: Buffer) -> int:
    return data.nbytes if isinstance(data, memoryview) else len(data)
