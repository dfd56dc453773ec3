"""The protocol of GR00T: requests with the name of an endpoint, over ZMQ, as msgpack.

Arrays are the bytes of `np.save`, or maps of the package `msgpack-numpy`; which of them a server speaks is
told by its answers. The reference is `gr00t/policy/server_client.py` of NVIDIA/Isaac-GR00T. How messages
travel is in `groot_socket`.
"""

import io
import math
import re
from contextlib import AbstractAsyncContextManager
from typing import Any, NamedTuple

import msgpack
import numpy as np

from offboard.common.errors import BadValue, CloudBroken, OffloadError, ProtocolError
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
)

GROOT = "groot://"
HEADER_BYTES_MAX = 1024  # of an array: dtype and shape
_CLASS, _BYTES = "__ndarray_class__", "as_npy"
_NUMBERS = "biuf"  # kinds of dtypes that cross
_DTYPE = re.compile(r"[<>|=]?[biuf][1-8]")


class GrootCall(NamedTuple):
    """A request to another endpoint than `get_action`, or an observation with options."""

    endpoint: str
    data: dict[str, Any] | None = None


class Groot:
    """The protocol, for one server. An action is the pair of actions and info that the server returns.

    token: the `api_token` of each request.
    """

    converts = False

    def __init__(self, endpoint: str, token: str | None = None) -> None:
        self._endpoint, self._token = endpoint.removeprefix(GROOT), token
        self._maps: bool | None = None  # whether the server speaks msgpack-numpy; None: not known yet
        self._tries_maps = False

    def open(self) -> "AbstractAsyncContextManager[Channel]":
        from offboard.robot_client.policy_servers.groot_socket import open_groot_socket

        return open_groot_socket(self._endpoint, ANSWER_BYTES_MAX, ping=self.pack(GrootCall("ping")))

    async def greet(self, channel: Channel) -> dict[Any, Any]:
        """Send a ping: a server answers it once its model is loaded."""
        try:
            async with timeout(OPEN_S):
                await channel.send(self.pack(GrootCall("ping")))
                found = self.read(await channel.receive())
        except TimeoutError as error:
            raise CloudBroken("it answers no ping") from error
        return found if isinstance(found, dict) else {}

    def pack(self, item: Any) -> bytes:
        call = (
            item
            if isinstance(item, GrootCall)
            else GrootCall("get_action", {"observation": item, "options": None})
        )
        request: dict[str, Any] = {"endpoint": call.endpoint}
        if call.data is not None:
            request["data"] = call.data
        if self._token is not None:
            request["api_token"] = self._token
        maps = self._tries_maps if self._maps is None else self._maps
        packed: bytes = msgpack.packb(request, default=_map_of if maps else _npy_of)
        if len(packed) > OBSERVATION_BYTES_MAX:
            raise BadValue(f"it has {len(packed)} bytes; at most {OBSERVATION_BYTES_MAX} are allowed")
        check_items(packed, "it", BadValue)
        return packed

    def forward(self, raw: Raw) -> bytes:
        if self._token is None:
            return raw.data
        request = unpack_bounded(raw.data, OBSERVATION_BYTES_MAX)
        if not isinstance(request, dict):
            raise BadValue("the request is no map")
        packed: bytes = msgpack.packb({**request, "api_token": self._token})
        return packed

    def read_request(self, data: bytes) -> Any:
        request = self.read_call(data)
        call = GrootCall(request.get("endpoint", "get_action"), request.get("data"))
        return observation_of(call)

    def read_call(self, data: bytes) -> dict[str, Any]:
        """The request of a client, with the name of its endpoint. ProtocolError if it is none."""
        check_items(data, "the request", ProtocolError)
        request = self._value(unpack_bounded(data, OBSERVATION_BYTES_MAX), 0)
        if not isinstance(request, dict):
            raise ProtocolError("the request is no map")
        return request

    def pack_answer(self, value: Any) -> bytes:
        return self.pack_value(list(value) if isinstance(value, tuple) else [value, {}])

    def pack_value(self, value: Any) -> bytes:
        """The bytes of a value, in the encoding of what was read."""
        packed: bytes = msgpack.packb(value, default=_map_of if self._maps else _npy_of)
        return packed

    def read(self, message: bytes | str) -> Any:
        assert isinstance(message, bytes)
        if message == b"ERROR":
            raise failed("ERROR")
        check_items(message, "the value", ProtocolError)
        value = self._value(unpack_bounded(message, ANSWER_BYTES_MAX), 0)
        if isinstance(value, dict) and "error" in value:
            if self._maps is None:  # perhaps it speaks the other one
                self._tries_maps = not self._tries_maps
            raise failed(value["error"])
        if not isinstance(value, list):
            return value
        for part in value[:1]:
            check_finite(part)
        return tuple(value)

    def run_s(self, value: Any) -> float | None:  # noqa: ARG002 - it does not say
        return None

    def _value(self, tree: Any, depth: int) -> Any:
        if depth > NESTING_MAX:
            raise ProtocolError(f"value nests deeper than {NESTING_MAX} levels")
        if isinstance(tree, list):
            return [self._value(one, depth + 1) for one in tree]
        if isinstance(tree, dict):
            if _CLASS in tree:
                self._maps = False
                return array_of(tree.get(_BYTES))
            named = {
                key.decode("ascii", "replace") if isinstance(key, bytes) else key: one
                for key, one in tree.items()
            }
            if "nd" in named and {"type", "data"} <= named.keys():
                self._maps = True
                return _of_map(named)
            return {key: self._value(one, depth + 1) for key, one in tree.items()}
        if isinstance(tree, msgpack.ExtType | msgpack.Timestamp):
            raise ProtocolError(f"unexpected {type(tree).__name__} in a value")
        return tree


def observation_of(item: Any) -> Any:
    """What another policy than a server of GR00T gets: the observation without what is around it."""
    if not isinstance(item, GrootCall):
        return item
    if item.endpoint != "get_action" or item.data is None:
        raise OffloadError(f"{item.endpoint}: only servers of GR00T have such a request")
    return item.data["observation"]


def array_of(data: Any) -> "np.ndarray[Any, Any]":
    """The array in the bytes of `np.save`, read-only; ProtocolError for anything but plain numbers."""
    if not isinstance(data, bytes):
        raise ProtocolError("an array has no bytes")
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[
            version
        ]
        shape, by_columns, dtype = read(file, max_header_size=HEADER_BYTES_MAX)
    except Exception as error:  # NumPy raises many kinds for a malformed header
        raise ProtocolError(f"an array has a header that cannot be read: {str(error)[:80]}") from error
    return _array(shape, dtype, data[file.tell() :], order="F" if by_columns else "C")


def _of_map(tree: dict[Any, Any]) -> Any:
    """An array or a number of msgpack-numpy."""
    name = tree["type"].decode("ascii", "replace") if isinstance(tree["type"], bytes) else tree["type"]
    if not isinstance(name, str) or not _DTYPE.fullmatch(name):
        raise ProtocolError(f"an array of dtype {name!r:.80} is not allowed")
    try:
        dtype = np.dtype(name)
    except TypeError as error:
        raise ProtocolError(f"an array of dtype {name!r:.80} is not allowed") from error
    if tree["nd"] is True:
        return _array(tuple(tree.get("shape") or ()), dtype, tree["data"], order="C")
    return _array((), dtype, tree["data"], order="C")[()]


def _array(shape: Any, dtype: "np.dtype[Any]", data: Any, *, order: Any) -> "np.ndarray[Any, Any]":
    if dtype.kind not in _NUMBERS:
        raise ProtocolError(f"an array of dtype {dtype!r:.80} is not allowed")
    if len(shape) > DIMENSIONS_MAX or not all(type(n) is int and 0 <= n < 2**63 for n in shape):
        raise ProtocolError(f"array shape {shape!r:.80} is not allowed")
    if not isinstance(data, bytes) or math.prod(shape) * dtype.itemsize != len(data):
        raise ProtocolError(f"an array of shape {shape!r:.80} and dtype {dtype} has other data")
    return np.ndarray(shape, dtype, buffer=data, order=order)


def _checked(value: Any) -> Any:
    if not isinstance(value, np.ndarray | np.generic):
        raise BadValue(f"a value of type {type(value).__module__}.{type(value).__qualname__} cannot be sent")
    if value.dtype.kind not in _NUMBERS:
        raise BadValue(f"an array or number of dtype {value.dtype} cannot be sent")
    return value


def _npy_of(value: Any) -> Any:
    """What msgpack packs instead of an array."""
    if isinstance(_checked(value), np.generic):
        return value.item()
    file = io.BytesIO()
    np.save(file, value, allow_pickle=False)
    return {_CLASS: True, _BYTES: file.getvalue()}


def _map_of(value: Any) -> Any:
    """The same for a server that speaks msgpack-numpy."""
    kind, data = _checked(value).dtype.str, value.tobytes()
    if isinstance(value, np.generic):
        return {b"nd": False, b"type": kind, b"data": data}
    return {b"nd": True, b"type": kind, b"kind": b"", b"shape": value.shape, b"data": data}
