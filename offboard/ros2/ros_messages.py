"""The message classes of a ROS installation, for the converters.

`node` alone imports rclpy; messages do not need it.
"""

import array
import functools
import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.ros2.converters import Library


@functools.cache
def find(name: str) -> Callable[..., Any]:
    """The class of `PACKAGE/msg/NAME`."""
    package, folder, kind = name.split("/")
    found: Callable[..., Any] = getattr(importlib.import_module(f"{package}.{folder}"), kind)
    return found


def numbers(values: NDArray[Any]) -> "array.array[Any]":
    """The only sequence that messages take without looking at each number."""
    made = array.array(np.dtype(values.dtype).char)
    made.frombytes(np.ascontiguousarray(values).data.cast("B"))
    return made


ROS = Library(find, numbers, lambda number: bytes([number]))
