"""The protocol of openpi: its messages, its greeting and its errors.

Messages are msgpack, in which a NumPy array is a map with fixed keys: the bytes are those of
`openpi_client.msgpack_numpy`. Sending them is left to `policy_server`.
"""

import math
import re
from contextlib import AbstractAsyncContextManager
from typing import Any

import msgpack
import numpy as np

from offboard.common.errors import BadValue, CloudBroken, ProtocolError
from offboard.common.wire.item_count import check_items
from offboard.common.wire.values import NESTING_MAX, unpack_bounded
from offboard.robot_client.policy_servers.asyncio_timeout import timeout
from offboard.robot_client.policy_servers.protocol import (
    ANSWER_BYTES_MAX,
    DIMENSIONS_MAX,
    OBSERVATION_BYTES_MAX,
    OPEN_S,
    Channel,
    Raw,
    check_finite,
    failed,
    shortened,
)

SCHEMES = ("Api-Key ", "Bearer ")

_ARRAY, _SCALAR, _DATA, _DTYPE, _SHAPE = b"__ndarray__", b"__npgeneric__", b"data", b"dtype", b"shape"
_UNSENDABLE = "VOc"  # kinds of dtypes: structured, objects, complex
_DTYPES = re.compile(r"[<>|=]?[biufSU][1-9]\d{0,8}")
# What a number or text holds, by the kind of its dtype. NumPy would make `n` zero bytes of the number `n`.
_HOLDS = dict[str, set[type]](b={bool}, i={int}, u={int}, f={float, int}, S={bytes}, U={str})


class OpenPi:
    """The protocol of openpi. Answers come in the order of the observations, and are not numbered.

    token: sent as `Authorization`; `Api-Key` comes before it, unless it names its scheme.
    """

    converts = False

    def __init__(self, endpoint: str, token: str | None = None) -> None:
        from offboard.robot_client.policy_servers.web_socket import open_web_socket  # its library is an extra

        self._endpoint, self._token, self._open = endpoint, token, open_web_socket

    def open(self) -> "AbstractAsyncContextManager[Channel]":
        token = self._token
        if token is not None and not token.startswith(SCHEMES):
            token = f"{SCHEMES[0]}{token}"
        return self._open(self._endpoint, ANSWER_BYTES_MAX, authorization=token)

    async def greet(self, channel: Channel) -> dict[Any, Any]:
        """The metadata of the server, its first message."""
        try:
            async with timeout(OPEN_S):
                metadata = await channel.receive()
        except TimeoutError as error:
            raise CloudBroken("it sends no metadata") from error
        if isinstance(metadata, str):
            raise ProtocolError(f"the server says: {shortened(metadata)}")
        found = unpack(metadata)
        if not isinstance(found, dict):
            raise ProtocolError("the first message of the server is no metadata")
        return found

    def pack(self, item: Any) -> bytes:
        return pack(item)

    def forward(self, raw: Raw) -> bytes:
        return raw.data

    def read_request(self, data: bytes) -> Any:
        return unpack(data, OBSERVATION_BYTES_MAX)

    def pack_answer(self, value: Any) -> bytes:
        return pack(value)

    def read(self, message: bytes | str) -> Any:
        if isinstance(message, str):
            raise failed(message)
        value = unpack(message)
        if isinstance(value, dict) and isinstance(value.get("type"), str) and value["type"] == "error":
            raise failed(value.get("message"))
        check_finite(value.get("actions") if isinstance(value, dict) else value)
        return value

    def run_s(self, value: Any) -> float | None:
        return _run_s(value)


def _run_s(value: Any) -> float | None:
    """The computing time that the server says, in seconds; None if it says nothing of the sort."""
    timing = value.get("server_timing") if isinstance(value, dict) else None
    ms = timing.get("infer_ms") if isinstance(timing, dict) else None
    if isinstance(ms, bool) or not isinstance(ms, int | float) or not (math.isfinite(ms) and ms >= 0):
        return None
    return ms / 1000


def pack(observation: Any) -> bytes:
    """The bytes of a value. An error that it raises says what cannot be sent."""
    packed: bytes = msgpack.packb(observation, default=_tree_of)
    if len(packed) > OBSERVATION_BYTES_MAX:
        raise BadValue(f"it has {len(packed)} bytes; at most {OBSERVATION_BYTES_MAX} are allowed")
    check_items(packed, "it", BadValue)
    return packed


def unpack(data: bytes, bytes_max: int = ANSWER_BYTES_MAX) -> Any:
    """The value in a message. Its arrays are read-only. ProtocolError for anything malformed."""
    check_items(data, "the value", ProtocolError)
    return _value(unpack_bounded(data, bytes_max), 0)


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
