"""Estimates how many bytes a value takes in a message, before it is decided whether the value is sent."""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from offboard.common.dataclass_types import fields_of
from offboard.common.errors import BadValue
from offboard.common.wire.blobs import DTYPES
from offboard.common.wire.values import BLOB_BYTES_MIN, NESTING_MAX

NUMBER_BYTES = 9  # of a float or a large integer in msgpack
LOOKS_MAX = 1000  # items that are looked at, in all lists of a value; the others count as the mean of them
GOLDEN = 0.6180339887498949  # multiples of it are spread evenly, and never in step with a list that repeats

Known = Callable[[memoryview], bool]


def payload_bytes(value: Any, known: Known = lambda _: False) -> int:
    """The bytes of arrays, texts and numbers; small integers count as much as large ones.

    A large array or `bytes` for which `known` returns True counts as nothing: the other side has it already.
    A value that cannot be read, such as a list that another thread changes, counts as a number.
    """
    try:
        return _bytes(value, known, LOOKS_MAX, 0)
    except Exception:  # noqa: BLE001 - the code of such a value may raise anything, and sending it says what
        return NUMBER_BYTES


def _bytes(value: Any, known: Known, looks: int, depth: int) -> int:
    if isinstance(value, np.ndarray):
        return 0 if _is_known(value, known) else value.nbytes
    if isinstance(value, bytes):
        return 0 if len(value) > BLOB_BYTES_MIN and known(memoryview(value)) else len(value)
    if isinstance(value, str):
        return len(value)
    if depth <= NESTING_MAX:
        if isinstance(value, list | tuple):
            return _of_items(value, known, looks, depth)
        if isinstance(value, dict):
            return _of_items([*value.keys(), *value.values()], known, looks, depth)
        if dataclasses.is_dataclass(type(value)):
            with contextlib.suppress(BadValue):
                return _of_items(list(fields_of(value).values()), known, looks, depth)
    return NUMBER_BYTES


def _of_items(items: Sequence[Any], known: Known, looks: int, depth: int) -> int:
    seen = items
    if len(items) > looks:
        seen = [items[int(n * GOLDEN % 1.0 * len(items))] for n in range(looks)]
    each = max(1, looks // max(1, len(seen)))
    return sum([_bytes(one, known, each, depth + 1) for one in seen]) * len(items) // max(1, len(seen))


def _is_known(array: "np.ndarray[Any, Any]", known: Known) -> bool:
    if array.nbytes <= BLOB_BYTES_MIN or not array.flags.c_contiguous or array.dtype.str not in DTYPES:
        return False
    return known(array.reshape(-1).view(np.uint8).data)
