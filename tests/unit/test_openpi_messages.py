"""The messages of the openpi protocol: golden bytes, what is sent, and what is refused."""

import contextlib
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from offboard.common.errors import BadValue, ProtocolError
from offboard.robot_client.policy_servers import openpi
from offboard.robot_client.policy_servers.openpi import pack, unpack

# {"a": np.array([1, 2], np.int16), "b": np.float32(0.5)}, as openpi-client 0.1.2 packs it.
GOLDEN = bytes.fromhex(
    "82a16184c40b5f5f6e6461727261795f5fc3c40464617461c40401000200c4056474797065a33c6932c405736861706591"
    "02a16283c40d5f5f6e7067656e657269635f5fc3c40464617461cb3fe0000000000000c4056474797065a33c6634"
)


def array(**fields: Any) -> bytes:
    whole = {"data": b"\0" * 8, "dtype": "<f4", "shape": [2]} | fields
    return bytes(msgpack.packb({b"__ndarray__": True} | {key.encode(): one for key, one in whole.items()}))


def scalar(data: Any, dtype: str) -> bytes:
    return bytes(msgpack.packb({b"__npgeneric__": True, b"data": data, b"dtype": dtype}))


def test_golden_bytes() -> None:
    """The format stays as it is."""
    assert pack({"a": np.array([1, 2], np.int16), "b": np.float32(0.5)}) == GOLDEN
    value = unpack(GOLDEN)
    assert value["a"].tolist() == [1, 2]
    assert value["a"].dtype == np.int16
    assert value["b"] == np.float32(0.5)
    assert isinstance(value["b"], np.float32)


@pytest.mark.parametrize(
    "value",
    [
        np.zeros((0, 3)),
        np.array(4.0),
        np.arange(24, dtype=">i4").reshape(2, 3, 4)[:, ::2],
        np.array(["asdf", "q"]),
        np.array([True, False]),
        np.asfortranarray(np.ones((3, 2), np.float16)),
    ],
)
def test_an_array_comes_back_as_it_was(value: "np.ndarray[Any, Any]") -> None:
    """With dtype and shape, and read-only."""
    back = unpack(pack([value]))[0]
    assert (back.dtype, back.shape) == (value.dtype, value.shape)
    assert np.array_equal(back, value)
    assert not back.flags.writeable


@pytest.mark.parametrize("value", [np.float16(0.1), np.bool_(True), np.uint8(9)])
def test_a_number_comes_back_as_it_was(value: "np.generic[Any]") -> None:
    """With its type."""
    back = unpack(pack(value))
    assert back == value
    assert type(back) is type(value)


def test_a_number_that_is_too_large_becomes_infinite() -> None:
    """Without a warning of NumPy, which would be an error in some programs."""
    assert unpack(scalar(1e300, "<f4")) == np.inf


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (np.array([{}]), "dtype object cannot be sent"),
        (np.array([1j]), "dtype complex128 cannot be sent"),
        (np.zeros(2, [("x", "<f4")]), "cannot be sent"),
        (object(), "a value of type builtins.object cannot be sent"),
        ({1, 2}, "a value of type builtins.set cannot be sent"),
    ],
)
def test_what_openpi_cannot_send_is_refused(value: Any, text: str) -> None:
    """The error names the type."""
    with pytest.raises(BadValue, match=text):
        pack({"state": value})


def test_an_observation_has_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is checked after packing, because only then the size is known."""
    monkeypatch.setattr(openpi, "OBSERVATION_BYTES_MAX", 1000)
    with pytest.raises(BadValue, match=r"it has \d+ bytes; at most 1000 are allowed"):
        pack({"image": np.zeros(1000, np.uint8)})


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x01\x02",
        b"\xdd\xff\xff\xff\xff",  # announces four billion items
        array(data=b"\0" * 7),
        array(data="text"),
        array(shape=[-1, -2]),
        array(shape=[1.5]),
        array(shape=2),
        array(shape=[0, 2**63]),
        array(shape=[0] * 40, data=b""),
        array(dtype="O"),
        array(dtype="V8"),
        array(dtype="<c8", shape=[1]),
        array(dtype="<f3"),
        array(dtype="f4,f4", shape=[1]),
        array(dtype="S0", shape=[10**9], data=b""),
        array(dtype=4),
        scalar(300, "|u1"),
        scalar([1], "<f4"),
        scalar("x", "<f4"),
        scalar("1", "<i4"),
        scalar(True, "<i4"),
        scalar(b"x", "<U1"),
        scalar(2**50, "|S1"),  # NumPy would take a petabyte of memory
        msgpack.packb(msgpack.ExtType(7, b"x")),
        msgpack.packb(msgpack.Timestamp(0)),
        b"\x91" * 100 + b"\xc0",
    ],
)
def test_a_malformed_message_is_a_protocol_error(data: bytes) -> None:
    """Nothing else is raised, whatever a server sends."""
    with pytest.raises(ProtocolError):
        unpack(data)


@given(st.binary(max_size=200) | st.binary(max_size=60).map(lambda tail: GOLDEN[:40] + tail))
def test_any_bytes_give_a_value_or_a_protocol_error(data: bytes) -> None:
    """Garbage raises no other error."""
    with contextlib.suppress(ProtocolError):
        unpack(data)
