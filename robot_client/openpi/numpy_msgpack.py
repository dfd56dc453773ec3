"""The messages of the openpi protocol: msgpack, in which a NumPy array is a map with fixed keys.

The bytes are those of `openpi_client.msgpack_numpy`. Sending them is left to `policy_server`.
"""

import math
import re
from typing import Any

import msgpack
import numpy as np

from offboard.common.errors import BadValue, ProtocolError
from offboard.common.wire.item_count import check_items
from offboard.common.wire.values import NESTING_MAX, unpack_bounded

OBSERVATION_BYTES_MAX = 64 * 1024 * 1024
ANSWER_BYTES_MAX = 16 * 1024 * 1024
DIMENSIONS_MAX = 32

_ARRAY, _SCALAR, _DATA, _DTYPE, _SHAPE = b"__ndarray__", b"__npgeneric__", b"data", b"dtype", b"shape"
_UNSENDABLE = "VOc"  # kinds of dtypes: structured, objects, complex
_DTYPES = re.compile(r"[<>|=]?[biufSU][1-9]\d{0,8}")
# What a number or text holds, by the kind of its dtype. NumPy would make `n` zero bytes of the number `n`.
_HOLDS: dict[str, set[type]] = {
    "b": {bool},
    "i": {int},
    "u": {int},
    "f": {float, int},
    "S": {bytes},
    "U": {str},
}


def pack(observation: Any) -> bytes:
    """The bytes of a value. An error that it raises says what cannot be sent."""
    packed: bytes = msgpack.packb(observation, default=_tree_of)
    if len(packed) > OBSERVATION_BYTES_MAX:
        raise BadValue(f"it has {len(packed)} bytes; at most {OBSERVATION_BYTES_MAX} are allowed")
    check_items(packed, "it", BadValue)
    return packed


def unpack(data: bytes) -> Any:
    """The value in a message. Its arrays are read-only. ProtocolError for anything malformed."""
    check_items(data, "the value", ProtocolError)
    return _value(unpack_bounded(data, ANSWER_BYTES_MAX), 0)


def _tree_of(value: Any) -> Any:
    """What msgpack packs instead of a value that it does not know."""
    if not isinstance(value, np.ndarray | np.generic):
        raise BadValue(f"a value of type {type(value).__module__}.{type(value).__qualname__} cannot be sent")
    if value.dtype.kind in _UNSENDABLE:
        raise BadValue(f"an array or number of dtype {value.dtype} cannot be sent")
    if isinstance(value, np.ndarray):
        return {_ARRAY: True, _DATA: value.tobytes(), _DTYPE: value.dtype.str, _SHAPE: value.shape}
    return {_SCALAR: True, _DATA: value.item(), _DTYPE: value.dtype.str}


def _value(tree: Any, depth: int) -> Any:
    if depth > NESTING_MAX:
        raise ProtocolError(f"value nests deeper than {NESTING_MAX} levels")
    if isinstance(tree, list):
        return [_value(one, depth + 1) for one in tree]
    if isinstance(tree, dict):
        if _ARRAY in tree:
            return _array(tree)
        if _SCALAR in tree:
            return _scalar(tree)
        return {key: _value(one, depth + 1) for key, one in tree.items()}
    if isinstance(tree, msgpack.ExtType | msgpack.Timestamp):
        raise ProtocolError(f"unexpected {type(tree).__name__} in a value")
    return tree


def _array(tree: dict[Any, Any]) -> "np.ndarray[Any, Any]":
    data, dtype, shape = tree.get(_DATA), _dtype(tree), tree.get(_SHAPE)
    if not isinstance(shape, list) or len(shape) > DIMENSIONS_MAX:
        raise ProtocolError(f"an array shape is not a list of at most {DIMENSIONS_MAX} numbers")
    if not all(type(n) is int and 0 <= n < 2**63 for n in shape):
        raise ProtocolError(f"array shape {shape!r:.80} has a dimension that is not 0 to 2**63 - 1")
    if not isinstance(data, bytes) or math.prod(shape) * dtype.itemsize != len(data):
        raise ProtocolError(f"an array of shape {shape!r:.80} and dtype {dtype} has other data")
    try:
        return np.ndarray(shape, dtype, buffer=data)
    except (ValueError, TypeError, OverflowError) as error:
        raise ProtocolError(f"an array of shape {shape!r:.80}: {error}") from error


def _scalar(tree: dict[Any, Any]) -> Any:
    data, dtype = tree.get(_DATA), _dtype(tree)
    if type(data) not in _HOLDS[dtype.kind]:
        raise ProtocolError(f"a number or text of dtype {dtype} holds {type(data).__name__}")
    try:
        with np.errstate(over="ignore"):  # it becomes infinite
            return dtype.type(data)
    except (ValueError, TypeError, OverflowError) as error:
        raise ProtocolError(f"a number of dtype {dtype}: {error}") from error


def _dtype(tree: dict[Any, Any]) -> "np.dtype[Any]":
    name = tree.get(_DTYPE)
    if isinstance(name, str) and _DTYPES.fullmatch(name):
        try:
            return np.dtype(name)
        except TypeError:  # there are no numbers of this size
            pass
    raise ProtocolError(f"an array of dtype {name!r:.80} is not allowed")
