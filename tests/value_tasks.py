"""Tasks that say in words what they got, and dataclasses to send. Robot and server load them.

The words hold the type and every bit that a user can see. So a test compares words, and a difference is
readable.
"""

import dataclasses
import hashlib
from collections import OrderedDict, namedtuple
from collections.abc import Callable
from dataclasses import InitVar, dataclass, field
from datetime import date
from decimal import Decimal
from enum import IntEnum
from pathlib import PurePath
from typing import Any, Generic, TypeVar

import numpy as np

from offboard import task

SHOWN_MAX = 64  # bytes or characters; of more, the words hold the digest
DEPTH_MAX = 60  # a circle ends here

T = TypeVar("T")


@dataclass
class Point:
    x: Any
    y: Any = 0.0


@dataclass
class Child(Point):
    more: Any = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Frozen:
    value: Any
    rest: list[Any] = field(default_factory=list)


@dataclass(order=True, slots=True)
class Slotted(Generic[T]):
    value: T
    self: Any = None  # a name that the constructor of a dataclass needs itself


@dataclass
class Doubled:
    """A second `__post_init__` is visible."""

    value: Any

    def __post_init__(self) -> None:
        self.value = [self.value, self.value]


@dataclass(frozen=True)
class Upper:
    """`__post_init__` refuses what it has made itself."""

    text: str

    def __post_init__(self) -> None:
        if self.text.startswith("!"):
            raise ValueError("made twice")
        object.__setattr__(self, "text", f"!{self.text}")


@dataclass
class Seeded:
    """One field is made from a value that is not kept."""

    seed: InitVar[int]
    drawn: Any = field(init=False)

    def __post_init__(self, seed: int) -> None:
        self.drawn = -seed


@dataclass
class Unset:
    """A field without a value."""

    value: Any
    late: Any = field(init=False)


TYPES = (Point, Child, Frozen, Slotted, Doubled, Upper, Seeded, Unset)


class Level(IntEnum):
    HIGH = 3


class Text(str):
    __slots__ = ()


class Plain:
    pass


@dataclass
class Stranger:
    """A dataclass that no task lists in its `types`."""

    value: int = 1


Pair = namedtuple("Pair", "a b")


def circle() -> list[Any]:
    made: list[Any] = []
    made.append(made)
    return made


# What cannot be sent, by name.
FOREIGN: dict[str, Callable[[], Any]] = {
    "large int": lambda: 2**64,
    "small int": lambda: -(2**63) - 1,
    "huge int": lambda: 10**5000,
    "complex": lambda: 1 + 2j,
    "complex scalar": lambda: np.complex64(1 + 2j),
    "long scalar": lambda: np.longdouble(1) / 3,
    "date scalar": lambda: np.datetime64("2024-01-01"),
    "half a surrogate": lambda: "\ud800",
    "half a surrogate as key": lambda: {"\ud800": 1},
    "bytearray": lambda: bytearray(b"abc"),
    "memoryview": lambda: memoryview(b"abc"),
    "set": lambda: {1},
    "range": lambda: range(3),
    "ellipsis": lambda: ...,
    "named tuple": lambda: Pair(1, 2),
    "ordered dict": lambda: OrderedDict(a=1),
    "enum": lambda: Level.HIGH,
    "text subclass": lambda: Text("abc"),
    "date": lambda: date(2024, 1, 1),
    "decimal": lambda: Decimal("0.1"),
    "path": lambda: PurePath("a"),
    "object": Plain,
    "class": lambda: Point,
    "function": lambda: circle,
    "other dataclass": Stranger,
    "key None": lambda: {None: 1},
    "key bool": lambda: {True: 1},
    "key float": lambda: {1.5: 1},
    "key bytes": lambda: {b"a": 1},
    "key tuple": lambda: {(1, 2): 1},
    "key large int": lambda: {2**64: 1},
    "array of objects": lambda: np.array([None, 1]),
    "array of text": lambda: np.array(["a"]),
    "array of bytes": lambda: np.array([b"a"]),
    "array of dates": lambda: np.array(["2024-01-01"], "M8[D]"),
    "array of records": lambda: np.zeros(2, "i4,f4"),
    "array of long floats": lambda: np.zeros(2, np.longdouble),
    "masked array": lambda: np.ma.masked_array([1, 2], [True, False]),
    "matrix": lambda: np.zeros((2, 2)).view(np.recarray),
    "nine dimensions": lambda: np.zeros((1,) * 9),
    "circle": circle,
}


@task("crossing_seen", size=lambda value: 0.0, types=TYPES)  # noqa: ARG005 - no size
def seen(value: Any) -> list[Any]:
    """What the task got, in words, and the value itself."""
    return [described(value), value]


@task("crossing_made", size=lambda name: 0.0, types=TYPES)  # noqa: ARG005 - no size
def made(name: str) -> Any:
    """A value that cannot be sent."""
    return [FOREIGN[name]()]


def described(value: Any, depth: int = 0) -> str:
    """Type and value in words."""
    name = type(value).__name__
    if depth > DEPTH_MAX:
        return f"{name} .."

    def inner(one: Any) -> str:
        return described(one, depth + 1)

    if isinstance(value, np.ndarray):
        access = "writeable" if value.flags.writeable else "read-only"
        data = repr(value.tolist()).encode() if value.dtype.hasobject else value.tobytes()
        return f"{name} {value.dtype.str} {value.shape} {access} {_bytes(data)}"
    if isinstance(value, np.generic):
        return f"{name} {value.tobytes().hex()}"
    if isinstance(value, float):
        return f"{name} {'nan' if value != value else value.hex()}"
    if isinstance(value, bytes | bytearray | memoryview):
        return f"{name} {_bytes(bytes(value))}"
    if isinstance(value, dict):
        return f"{name} {{{', '.join(f'{inner(key)}: {inner(one)}' for key, one in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"{name} [{', '.join(map(inner, value))}]"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return f"{name}({', '.join(f'{key}={inner(one)}' for key, one in attributes(value).items())})"
    if isinstance(value, int):
        return f"{name} {int(value):x}"
    if isinstance(value, str):
        return f"{name} {ascii(value) if len(value) <= SHOWN_MAX else _bytes(value.encode())}"
    return name if type(value) is Plain else f"{name} {value!a}"


def attributes(value: Any) -> dict[str, Any]:
    """The fields of a dataclass that have a value, and whatever else it holds."""
    names = [one.name for one in dataclasses.fields(value)]
    fields = {name: getattr(value, name) for name in names if hasattr(value, name)}
    return fields | getattr(value, "__dict__", {})


def _bytes(data: bytes) -> str:
    if len(data) <= SHOWN_MAX:
        return data.hex()
    return f"{len(data)} bytes with SHA-256 {hashlib.sha256(data).hexdigest()[:16]}"
