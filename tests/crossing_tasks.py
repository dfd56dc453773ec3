"""Tasks whose arguments or results cannot be sent. Robot and server load them as `tests.crossing_tasks`."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from offboard.common.tasks import task

MIB = 2**20


@dataclass
class Known:
    x: Any
    y: Any = 0


@dataclass
class Unlisted:
    x: Any


@dataclass
class Raising:
    """A dataclass whose field cannot be read once `x` has been deleted."""

    x: Any

    def __getattr__(self, name: str) -> Any:
        raise RuntimeError(f"no {name} any more")


def circle() -> list[Any]:
    value: list[Any] = []
    value.append(value)
    return value


def deep() -> list[Any]:
    value: list[Any] = []
    for _ in range(40):
        value = [value]
    return value


def with_more() -> Known:
    value = Known(1)
    value.speed = 3  # type: ignore[attr-defined]
    return value


def with_less() -> Known:
    value = Known(1)
    del value.x
    return value


def raising() -> Raising:
    value = Raising(1)
    del value.x
    return value


class Sealed(list[Any]):
    """Its items cannot be read."""

    def __iter__(self) -> Iterator[Any]:
        raise RuntimeError("sealed")


# What cannot be sent, with a part of the reason.
UNSENDABLE: dict[str, tuple[Callable[[], Any], str]] = {
    "a set": (lambda: {"poses": [Known(1), Known({2})]}, "['poses'][1].x: a value of type builtins.set"),
    "an object": (object, ": a value of type builtins.object"),
    "a class": (lambda: [1, Known], "[1]: a value of type builtins.type"),
    "a dataclass that is not listed": (lambda: (Unlisted(1),), "[0]: a value of type tests.crossing_tasks.U"),
    "more than its fields": (with_more, ": Known has the attribute 'speed'"),
    "less than its fields": (with_less, ": a field of Known has no value: AttributeError"),
    "a field that raises": (raising, ": a field of Raising has no value: RuntimeError: no x any more"),
    "a large number": (lambda: {"n": [0, 2**64]}, "['n'][1]: "),
    "half a character": (lambda: ["\ud800"], "[0]: "),
    "a key": (lambda: [{(1, 2): 3}], "[0]: a dict key of type tuple"),
    "objects in an array": (
        lambda: [np.full(20_000, None)],
        "[0]: an array of 1 dimensions and dtype object",
    ),
    "dates": (
        lambda: np.full(20_000, "2024-01-01", "M8[D]"),
        ": an array of 1 dimensions and dtype datetime",
    ),
    "a masked array": (lambda: np.ma.zeros(20_000), ": a value of type numpy.ma.MaskedArray"),
    "a list that cannot be read": (lambda: Sealed([1]), ": a value of type tests.crossing_tasks.Sealed"),
    "a view of terabytes": (
        lambda: [np.broadcast_to(np.uint8(0), (2**42,))],
        "[0]: an array of 4398046511104 bytes; at most ",
    ),
    "too deep": (deep, "the value nests deeper than 32 levels"),
    "a circle": (circle, "the value nests deeper than 32 levels"),
    "too many arrays": (lambda: [np.zeros(1)] * 1001, ": the value holds more than 1000 arrays"),
    "too many numbers": (lambda: [0] * 1_000_000, " has more than 1000000 items"),
    "too long": (lambda: ["x" * MIB] * 17, "bytes without its arrays; at most 16777216 are allowed"),
}
TOO_LARGE = 2 * MIB  # for a server with --message-mib 1


@task("crossing_echo", size=lambda _: 0.0, types=(Known, Raising))
def crossing_echo(value: Any) -> Any:
    return value


@task("crossing_make", size=lambda _: 0.0, types=(Known, Raising))
def crossing_make(name: str) -> Any:
    return UNSENDABLE[name][0]() if name in UNSENDABLE else 1


@task("crossing_zeros", size=float)
def crossing_zeros(count: int) -> Any:
    return np.zeros(count, np.uint8)


def same(one: Any, other: Any) -> bool:
    """Whether two unsendable values are alike: of the same class, and with the same fields or length."""
    if type(one) is not type(other):
        return False
    if dataclasses.is_dataclass(one):
        return vars(one) == vars(other)
    return not hasattr(one, "__len__") or len(one) == len(other)
