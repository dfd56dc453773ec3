"""Estimates how many bytes a value takes in a message, without encoding it.

A prediction needs the bytes before it is decided whether the value is sent at all. `values` encodes it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from offboard.common.wire.values import BLOB_BYTES_MIN, NESTING_MAX

NUMBER_BYTES = 9  # of a float or a large integer in msgpack
ITEMS_MAX = 1000  # of a list whose items are looked at one by one; the rest of it counts as the mean of them


def payload_bytes(value: Any, known: Callable[[memoryview], bool] = lambda _: False, depth: int = 0) -> int:
    """The bytes of plain values, arrays and dataclasses.

    A large array or `bytes` for which `known` returns True counts as nothing: the other side has it already.
    """
    if isinstance(value, np.ndarray):
        return 0 if _is_known(value, known) else value.nbytes
    if isinstance(value, bytes):
        return 0 if len(value) > BLOB_BYTES_MIN and known(memoryview(value)) else len(value)
    if isinstance(value, str):
        return len(value)
    if depth <= NESTING_MAX:
        if isinstance(value, list | tuple):
            return _of_items(value, known, depth)
        if isinstance(value, dict):
            keys = sum(len(key) if isinstance(key, str) else NUMBER_BYTES for key in value)
            return keys + _of_items(list(value.values()), known, depth)
        if dataclasses.is_dataclass(value):
            fields = [getattr(value, one.name) for one in dataclasses.fields(value)]
            return _of_items(fields, known, depth)
    return NUMBER_BYTES


def _of_items(items: "list[Any] | tuple[Any, ...]", known: Callable[[memoryview], bool], depth: int) -> int:
    if len(items) <= ITEMS_MAX:
        return sum([payload_bytes(one, known, depth + 1) for one in items])
    seen = sum([payload_bytes(one, known, depth + 1) for one in items[:ITEMS_MAX]])
    return seen * len(items) // ITEMS_MAX


def _is_known(array: "np.ndarray[Any, Any]", known: Callable[[memoryview], bool]) -> bool:
    if array.nbytes <= BLOB_BYTES_MIN or not array.flags.c_contiguous:
        return False
    return known(array.reshape(-1).view(np.uint8).data)
