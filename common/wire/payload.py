"""Estimates how many bytes a value takes in a message, without encoding it.

A prediction needs the bytes before it is decided whether the value is sent at all. `values` encodes it.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from offboard.common.wire.values import BLOB_BYTES_MIN, NESTING_MAX

NUMBER_BYTES = 9  # of a float or a large integer in msgpack
ARRAY_BYTES = 13  # of the type and the shape of an array
DATACLASS_BYTES = 6  # around the name and the fields of a dataclass
ITEMS_MAX = 1000  # of a list that are looked at; the rest of it counts as the mean of them
PLACES = 10  # of a long list, in which neighbours are looked at: numbers may grow, and may come in groups
SHORT_LIST, SHORT_TEXT = 16, 32  # msgpack needs one byte for the length of shorter ones

Known = Callable[[memoryview], bool]


def payload_bytes(value: Any, known: Known = lambda _: False) -> int:
    """The bytes of plain values, arrays and dataclasses, to 10 % from 1 kB on.

    A large array or `bytes` for which `known` returns True counts as nothing: the other side has it already.
    """
    return _bytes(value, known, ITEMS_MAX, 0)


def _bytes(value: Any, known: Known, looks: int, depth: int) -> int:
    """`looks`: how many items of a list are looked at, those of lists inside it included."""
    if isinstance(value, np.ndarray):
        return 0 if _is_known(value, known) else ARRAY_BYTES + value.nbytes
    if isinstance(value, bytes):
        big = len(value) > BLOB_BYTES_MIN
        return 0 if big and known(memoryview(value)) else _length_bytes(value) + len(value)
    if depth <= NESTING_MAX:
        if isinstance(value, list | tuple):
            return _length_bytes(value, SHORT_LIST) + _items_bytes(value, known, looks, depth)
        if isinstance(value, dict):
            both = [*value.keys(), *value.values()]
            return _length_bytes(value, SHORT_LIST) + _all_bytes(both, known, looks, depth)
        if dataclasses.is_dataclass(value):
            fields = [one.name for one in dataclasses.fields(value) if one.init]
            both = [type(value).__name__, *fields, *(getattr(value, one) for one in fields)]
            return DATACLASS_BYTES + _all_bytes(both, known, looks, depth)
    return _scalar_bytes(value)


def _items_bytes(items: Sequence[Any], known: Known, looks: int, depth: int) -> int:
    """If there are many items, a few neighbours are looked at in each of some places."""
    if len(items) <= looks:
        return _all_bytes(items, known, looks, depth)
    places = min(looks, PLACES)
    step, together = -(-len(items) // places), looks // places
    seen = [one for first in range(0, len(items), step) for one in items[first : first + together]]
    return _all_bytes(seen, known, looks, depth) * len(items) // len(seen)


def _all_bytes(items: Sequence[Any], known: Known, looks: int, depth: int) -> int:
    if set(map(type, items)) == {float}:
        return NUMBER_BYTES * len(items)
    each = max(1, looks // max(1, len(items)))
    return sum([_bytes(one, known, each, depth + 1) for one in items])


def _scalar_bytes(value: Any) -> int:
    if isinstance(value, str):
        length = len(value) if value.isascii() else len(value.encode(errors="replace"))
        return (1 if length < SHORT_TEXT else 2) + length
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool):
        return 1
    return _integer_bytes(value) if isinstance(value, int) else NUMBER_BYTES


def _integer_bytes(value: int) -> int:
    """As msgpack chooses: small numbers are their own type, others take 8, 16, 32 or 64 bits after it."""
    if -SHORT_TEXT <= value < 128:
        return 1
    bits = value.bit_length() if value >= 0 else (~value).bit_length() + 1
    return 1 + next((size for size in (1, 2, 4) if bits <= 8 * size), 8)


def _length_bytes(value: Any, short: int = 0) -> int:
    count = len(value)
    return 1 if count < short else 2 if count < 256 else 3


def _is_known(array: "np.ndarray[Any, Any]", known: Known) -> bool:
    if array.nbytes <= BLOB_BYTES_MIN or not array.flags.c_contiguous:
        return False
    return known(array.reshape(-1).view(np.uint8).data)
