"""Tasks that pack their arguments, and two that do not. Robot and server load `tests.packing_tasks`."""

import os
import time
from typing import Any

import numpy as np

from offboard.common.tasks import task

PACK_S = 0.2
packed: list[int] = []  # the sizes of what this process has packed


def to_half(array: Any) -> Any:
    packed.append(array.size)
    return array.astype(np.float16)


def to_double(half: Any) -> Any:
    return half.astype(np.float64)


@task("packing_half", size=len, pack=to_half, unpack=to_double)
def half(array: Any) -> list[Any]:
    """The sum, the type of the argument, and the process that ran the task."""
    return [float(array.sum()), str(array.dtype), os.getpid()]


def join(first: Any, second: Any) -> Any:
    return {"both": [first, second]}


def split(value: Any) -> tuple[Any, Any]:
    return tuple(value["both"])


@task("packing_two", size=lambda *_: 0.0, pack=join, unpack=split)
def two(first: Any, second: Any = 5) -> list[Any]:
    return [first, second, os.getpid()]


def refuse(value: Any) -> Any:
    raise ValueError(f"no picture: {value}")


@task("packing_unreadable", size=lambda _: 0.0, pack=str, unpack=refuse, duplicate=False)
def unreadable(value: Any) -> list[Any]:
    return [value, os.getpid()]


@task("packing_raises", size=lambda _: 0.0, pack=refuse, unpack=str, duplicate=False)
def raises(value: Any) -> list[Any]:
    return [value, os.getpid()]


def slowly(value: Any) -> str:
    time.sleep(PACK_S)
    return str(value)


@task("packing_slow", size=lambda _: 0.0, pack=slowly, unpack=str, duplicate=False)
def slow(value: Any) -> list[Any]:
    return [value, os.getpid()]


@task("packing_image", size=lambda image: image.size)
def image(image: Any) -> int:
    return int(image.sum(dtype=np.int64))


@task("packing_noise", size=lambda image: image.size)
def noise(image: Any) -> int:
    return int(image.sum(dtype=np.int64))
