"""Encodes arguments and results: msgpack, raw buffers of arrays, and blobs named by their SHA-256."""

import contextlib
import hashlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np

from offboard.common.dataclass_types import field_names, fields_of, rebuilt
from offboard.common.errors import BadValue, ProtocolError, describe
from offboard.common.wire.blobs import (
    DTYPES,
    Array,
    Buffer,
    StoredBlob,
    array_digest,
    array_view,
    byte_length,
    checked_dtype,
)
from offboard.common.wire.compression import decompress
from offboard.common.wire.item_count import ITEMS_MAX, TOO_MANY_ITEMS, count_items

BLOB_BYTES_MIN = 64 * 1024  # a larger argument is a blob
VALUE_BYTES_MAX = 16 * 1024 * 1024  # of the msgpack part of a value, without its arrays
ARRAYS_MAX = 1000  # arrays of one value that are sent in frames
BLOBS_MAX = 64  # blobs that one value may refer to
DECOMPRESSED_BYTES_MAX = 16 * 1024 * 1024  # of the arrays of one value that are sent compressed in frames
UNSCANNED_BYTES_MAX = 512  # of msgpack that is too short to announce a harmful number of items
NESTING_MAX = 32
DATACLASS_LEVELS = 3  # that a dataclass counts as: its message is a list with a map in it
DIMENSIONS_MAX = 8
ARRAY_BYTES_MAX = 2**31 - 1  # of one array: no message is larger
PLACE_BYTES_MAX = 128  # of the msgpack that names the frame or blob of an array, its dtype and its shape
PLACE_LENGTH_MAX = 80  # of the text that says where a bad part is

_IN_FRAME, _IN_BLOB, _DATACLASS, _COMPRESSED = 1, 2, 3, 4
_SCALARS = {type(None), bool, int, float, str}
_Along = Callable[[int, memoryview], Buffer | None]
_UNPACK_ERRORS = (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException)


@dataclass(frozen=True, slots=True)
class Body:
    """An encoded value: frame 0 is msgpack, the others are raw or compressed arrays.

    `blobs` holds its blobs by digest, and `arguments` the numbers of the arguments that they belong to.
    """

    frames: list[Buffer]
    blobs: dict[bytes, memoryview] = field(default_factory=dict)
    arguments: dict[bytes, int] = field(default_factory=dict)


def encode(
    value: Any,
    types: Sequence[type] = (),
    *,
    name: str = "",
    blobs: bool = False,
    along: _Along = lambda *_: None,
    array_bytes_max: int = ARRAY_BYTES_MAX,
) -> Body:
    """Encode None, bool, int, float, str, bytes, list, tuple, dict, arrays and dataclasses of `types`.

    With `blobs`, each array or bytes larger than BLOB_BYTES_MIN becomes a blob: the value holds only its
    digest. `along` is called with the number of the argument, which is its place in a list `value`, and the
    bytes of an array. If it returns them, or other bytes, which are then the compressed ones, these are sent
    in a frame instead. Arrays are not copied, so do not change them before the frames are sent. One that is
    not contiguous is copied, unless it has more than `array_bytes_max`. BadValue says what cannot be sent and
    where it is, such as `result['poses'][3].x`; `name` is its first word. All items together are limited too.
    """
    encoder = _Encoder(types, use_blobs=blobs, along=along, array_bytes_max=array_bytes_max)
    try:
        main = encoder.pack(value, 0)
    except _TooManyItems as error:  # no part of the value is to blame
        raise BadValue(f"{name or 'the value'} has {error}") from None
    except BadValue as error:
        place = _place_of_bad(value, encoder, 0)
        if len(place) > PLACE_LENGTH_MAX:
            place = place[: PLACE_LENGTH_MAX - 3] + "..."
        place = name + place
        raise BadValue(f"{place}: {error}" if place else str(error)) from error
    if len(main) > VALUE_BYTES_MAX:
        raise BadValue(
            f"{name or 'the value'} takes {len(main)} bytes without its arrays; "
            f"at most {VALUE_BYTES_MAX} are allowed"
        )
    return Body([main, *encoder.frames], encoder.blobs, encoder.arguments)


def decode(frames: Sequence[Buffer], types: Sequence[type], blobs: Mapping[bytes, StoredBlob]) -> Any:
    """The value in `frames`. Arrays are read-only views on them. ProtocolError for anything malformed."""
    if not 1 <= len(frames) <= 1 + ARRAYS_MAX:
        raise ProtocolError(f"value of {len(frames)} frames; allowed are 1 to {1 + ARRAYS_MAX}")
    return _Decoder(frames, types, blobs).unpack(frames[0], 0)


def unpack_bounded(data: Buffer, bytes_max: int) -> Any:
    """Unpack msgpack to a tree of plain values. Extension values stay ExtType."""
    if byte_length(data) > bytes_max:
        raise ProtocolError(f"msgpack of {byte_length(data)} bytes; at most {bytes_max} are allowed")
    try:
        # Unpacking allocates memory as soon as a number of items is announced: for each byte, up to as many
        # items as the data has bytes. Skipping first proves that all announced items exist.
        if byte_length(data) > UNSCANNED_BYTES_MAX:
            scan = msgpack.Unpacker(max_buffer_size=bytes_max, strict_map_key=False)
            scan.feed(data)
            scan.skip()
        return msgpack.unpackb(data, strict_map_key=False)
    except _UNPACK_ERRORS as error:
        raise ProtocolError(f"not msgpack: {type(error).__name__} {error}") from error


class _TooManyItems(BadValue):
    """The value has more than ITEMS_MAX items."""


class _Encoder:
    """Turns a value into a tree for msgpack, and collects the frames of arrays and the blobs."""

    def __init__(
        self, types: Sequence[type], *, use_blobs: bool, along: _Along, array_bytes_max: int
    ) -> None:
        self.types = types
        self.use_blobs = use_blobs
        self.along = along
        self.array_bytes_max = array_bytes_max
        self.frames: list[Buffer] = []
        self.blobs: dict[bytes, memoryview] = {}
        self.arguments: dict[bytes, int] = {}
        self._argument = 0
        self._items = 0  # as the reader will count them

    def pack(self, value: Any, depth: int) -> bytes:
        self._count(1)
        tree = self._tree(value, depth)
        try:
            packed: bytes = msgpack.packb(tree)
        except (ValueError, OverflowError) as error:
            raise BadValue(f"the value cannot be sent: {error}") from error
        return packed

    def _count(self, items: int) -> None:
        """Count the items of a list or dict before they are looked at."""
        self._items += items
        if self._items > ITEMS_MAX:
            raise _TooManyItems(TOO_MANY_ITEMS)

    def _tree(self, value: Any, depth: int) -> Any:
        kind = type(value)
        if kind in _SCALARS:
            return value
        if kind is bytes:
            return self._bytes(value)
        if depth > NESTING_MAX:
            raise BadValue(f"the value nests deeper than {NESTING_MAX} levels")
        if kind is list or kind is tuple:
            self._count(len(value))
            if set(map(type, value)) <= _SCALARS:
                return value
            if depth == 0:
                return list(map(self._part, itertools.count(), value))
            return [one if type(one) in _SCALARS else self._tree(one, depth + 1) for one in value]
        if kind is dict:
            self._count(2 * len(value))
            return {
                self._key(key): one if type(one) in _SCALARS else self._tree(one, depth + 1)
                for key, one in value.items()
            }
        return self._array(value) if kind is np.ndarray else self._object(value, depth)

    def _part(self, number: int, value: Any) -> Any:
        """An argument of a call, in the list of all of them."""
        self._argument = number
        return self._tree(value, 1)

    def _object(self, value: Any, depth: int) -> Any:
        kind = type(value)
        if isinstance(value, np.generic) and value.dtype.str in DTYPES and value.dtype.kind in "biuf":
            return value.item()
        if kind in self.types:
            named = [kind.__name__, fields_of(value)]
            return msgpack.ExtType(_DATACLASS, self.pack(named, depth + 1))
        raise BadValue(
            f"a value of type {kind.__module__}.{kind.__qualname__} cannot be sent; "
            "allowed are plain values, arrays, and dataclasses listed in @task(types=...)"
        )

    def _key(self, key: Any) -> str | int:
        if type(key) is str or type(key) is int:
            return key
        raise BadValue(f"a dict key of type {type(key).__qualname__} cannot be sent; use str or int")

    def _bytes(self, value: bytes) -> Any:
        if not self.use_blobs or len(value) <= BLOB_BYTES_MIN:
            return value
        digest = hashlib.sha256(value).digest()
        return self._blob(digest, memoryview(value), None, ())

    def _array(self, array: Array) -> Any:
        if array.dtype.str not in DTYPES or array.ndim > DIMENSIONS_MAX:
            raise BadValue(
                f"an array of {array.ndim} dimensions and dtype {array.dtype} cannot be sent; "
                f"allowed are {DIMENSIONS_MAX} dimensions of numbers"
            )
        # Such a view may have more bytes than there is memory.
        if not array.flags.c_contiguous and array.nbytes > self.array_bytes_max:
            raise BadValue(f"an array of {array.nbytes} bytes; at most {self.array_bytes_max} are allowed")
        raw = np.asarray(array, order="C").reshape(-1).view(np.uint8).data
        frame: Buffer = raw
        if self.use_blobs and raw.nbytes > BLOB_BYTES_MIN:
            along = self.along(self._argument, raw)
            if along is None:
                return self._blob(array_digest(array, raw), raw, array.dtype.str, array.shape)
            frame = along
        if len(self.frames) == ARRAYS_MAX:
            raise BadValue(f"the value holds more than {ARRAYS_MAX} arrays")
        self.frames.append(frame)
        place = (len(self.frames), array.dtype.str, array.shape)
        return msgpack.ExtType(_IN_FRAME if frame is raw else _COMPRESSED, msgpack.packb(place))

    def _blob(self, digest: bytes, raw: memoryview, dtype: str | None, shape: tuple[int, ...]) -> Any:
        self.blobs[digest], self.arguments[digest] = raw, self._argument
        if len(self.blobs) > BLOBS_MAX:
            raise BadValue(f"the value holds more than {BLOBS_MAX} arrays over {BLOB_BYTES_MIN} bytes")
        return msgpack.ExtType(_IN_BLOB, msgpack.packb((digest, dtype, shape)))


def _place_of_bad(value: Any, like: _Encoder, depth: int) -> str:
    """Where the part is that cannot be sent, such as `[0].pose['x']`. It is found by encoding each part."""
    for place, part, deeper in _parts(value, like.types, depth) if depth <= NESTING_MAX else ():
        encoder = _Encoder(
            like.types, use_blobs=False, along=lambda *_: None, array_bytes_max=like.array_bytes_max
        )
        try:
            encoder.pack(part, deeper)
        except BadValue:
            return place + _place_of_bad(part, like, deeper)
    return ""


def _parts(value: Any, types: Sequence[type], depth: int) -> Iterator[tuple[str, Any, int]]:
    """Each part of a value with its place and its depth."""
    kind = type(value)
    if kind is list or kind is tuple:
        yield from ((f"[{index}]", one, depth + 1) for index, one in enumerate(value))
    elif kind is dict:
        yield from ((f"[{key!r}]", one, depth + 1) for key, one in value.items() if type(key) in (str, int))
    elif kind in types:
        with contextlib.suppress(BadValue):
            yield from ((f".{name}", one, depth + DATACLASS_LEVELS) for name, one in fields_of(value).items())


class _Decoder:
    """Turns a tree from msgpack back into a value. The tree may come from anyone, so all of it is checked."""

    def __init__(
        self, frames: Sequence[Buffer], types: Sequence[type], blobs: Mapping[bytes, StoredBlob]
    ) -> None:
        self.frames = frames
        self.types = {cls.__name__: cls for cls in types}
        self.blobs = blobs
        self.bytes_left = DECOMPRESSED_BYTES_MAX
        self.counts = byte_length(frames[0]) > ITEMS_MAX  # each item takes at least one byte
        self.items_left = ITEMS_MAX

    def unpack(self, data: Buffer, depth: int) -> Any:
        if self.counts:
            self.items_left -= count_items(data, self.items_left)
            if self.items_left < 0:
                raise ProtocolError(f"the value has {TOO_MANY_ITEMS}")
        return self._value(unpack_bounded(data, VALUE_BYTES_MAX), depth)

    def _value(self, tree: Any, depth: int) -> Any:
        kind = type(tree)
        if kind in _SCALARS or kind is bytes:
            return tree
        if depth > NESTING_MAX:
            raise ProtocolError(f"value nests deeper than {NESTING_MAX} levels")
        if kind is list:
            if set(map(type, tree)) <= _SCALARS:
                return tree
            return [self._value(item, depth + 1) for item in tree]
        if kind is dict:
            if not set(map(type, tree)) <= {str, int}:
                raise ProtocolError("a dict key is neither str nor int")
            return {key: self._value(item, depth + 1) for key, item in tree.items()}
        if kind is msgpack.ExtType:
            return self._extension(tree.code, tree.data, depth)
        raise ProtocolError(f"unexpected {kind.__name__} in a value")

    def _extension(self, code: int, data: bytes, depth: int) -> Any:
        if code == _DATACLASS:
            return self._dataclass(self.unpack(data, depth + 1))
        tree = unpack_bounded(data, PLACE_BYTES_MAX)
        if code not in (_IN_FRAME, _IN_BLOB, _COMPRESSED) or not isinstance(tree, list) or len(tree) != 3:
            raise ProtocolError(f"unknown extension {code}")
        where, dtype, shape = tree[0], tree[1], _shape(tree[2])
        if code != _IN_BLOB:
            if type(where) is not int or not 1 <= where < len(self.frames):
                raise ProtocolError(f"array in frame {where!r} of {len(self.frames)}")
            frame = self.frames[where]
            if code == _COMPRESSED:
                frame = self._decompressed(frame, math.prod(shape) * checked_dtype(dtype).itemsize)
            return array_view(memoryview(frame).toreadonly(), dtype, shape)
        blob = self.blobs.get(where) if isinstance(where, bytes) else None
        if blob is None:
            raise ProtocolError("the value refers to a blob that the request does not list")
        return bytes(blob.data) if dtype is None else blob.array(checked_dtype(dtype).str, shape)

    def _decompressed(self, frame: Buffer, size: int) -> bytes:
        self.bytes_left -= size
        if self.bytes_left < 0:
            raise ProtocolError(f"compressed arrays of more than {DECOMPRESSED_BYTES_MAX} bytes")
        return decompress(frame, size)

    def _dataclass(self, tree: Any) -> Any:
        if not (isinstance(tree, list) and len(tree) == 2 and isinstance(tree[1], dict)):
            raise ProtocolError("a dataclass is not [name, fields]")
        name, fields = tree
        cls = self.types.get(name) if isinstance(name, str) else None
        if cls is None:
            raise ProtocolError(f"no dataclass {name!r:.80} is registered with this task")
        if fields.keys() != field_names(cls):
            raise ProtocolError(f"the fields of dataclass {name} differ from those on this side")
        try:
            return rebuilt(cls, fields)
        except Exception as error:
            raise ProtocolError(f"dataclass {name} refused its fields: {describe(error)}") from error


def _shape(shape: Any) -> tuple[int, ...]:
    if not isinstance(shape, list) or len(shape) > DIMENSIONS_MAX:
        raise ProtocolError(f"an array shape is not a list of at most {DIMENSIONS_MAX} numbers")
    if not all(type(n) is int and 0 <= n < 2**63 for n in shape):
        raise ProtocolError(f"array shape {shape!r:.80} has a dimension that is not 0 to 2**63 - 1")
    return tuple(shape)
