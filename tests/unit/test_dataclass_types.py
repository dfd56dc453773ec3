"""Sending dataclasses: an instance arrives as it was, and what cannot arrive so is refused."""

from collections.abc import Callable
from dataclasses import FrozenInstanceError, InitVar, dataclass, field, fields
from enum import IntEnum
from functools import cached_property
from typing import Any, Generic, TypeVar

import pytest

from offboard.common.dataclass_types import check_types
from offboard.common.errors import BadValue, ConfigError, ProtocolError
from offboard.common.tasks import kind_named, task
from offboard.common.wire.values import decode, encode

T = TypeVar("T")
made: list[object] = []  # by `__init__` or `__post_init__`


@dataclass
class Turned:
    """Each `__post_init__` turns degrees into radians once more."""

    angle: float
    unit: InitVar[float] = 0.5
    turns: int = field(init=False)
    name: str = field(default="none", init=False)

    def __post_init__(self, unit: float) -> None:
        made.append(self)
        self.angle *= unit
        self.turns = len(made)


@dataclass(frozen=True)
class Frozen:
    x: float
    y: float = field(default=0.0, kw_only=True)
    tags: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Slotted:
    x: float
    seen: int = field(default=3, init=False)


@dataclass(frozen=True, slots=True)
class Both:
    x: float
    seen: int = field(default=3, init=False)

    def __post_init__(self) -> None:
        made.append(self)
        object.__setattr__(self, "seen", self.seen + 1)


@dataclass
class Base:
    low: int


@dataclass
class Derived(Base):
    high: int = 9
    inner: "Derived | None" = None


@dataclass
class Box(Generic[T]):
    value: T


class Fussy:
    """A base that refuses to be made, or changed, in the usual way."""

    def __new__(cls) -> "Fussy":
        made.append(cls)
        return super().__new__(cls)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("fussy")


@dataclass(init=False)
class Own(Fussy):
    x: int

    def __init__(self) -> None:
        made.append(self)
        object.__setattr__(self, "x", 5)


def changed(value: Any, **values: Any) -> Any:
    for name, one in values.items():
        object.__setattr__(value, name, one)
    return value


VALUES: dict[str, Callable[[], Any]] = {
    "post-init and InitVar": lambda: Turned(180.0),
    "a field without init": lambda: changed(Turned(180.0), name="other", turns=70),
    "frozen, with a keyword-only field": lambda: Frozen(1.0, y=2.0, tags=["a"]),
    "slots": lambda: changed(Slotted(1.0), seen=8),
    "frozen and slots": lambda: changed(Both(1.0), seen=8),
    "inherited and nested": lambda: Derived(1, 2, Derived(3)),
    "generic": lambda: Box([1, Frozen(2.0)]),
    "its own init": lambda: changed(Own(), x=6),
}
TYPES = (Turned, Frozen, Slotted, Both, Derived, Box, Own)


def sent(value: Any) -> Any:
    return decode([bytes(frame) for frame in encode(value, TYPES).frames], TYPES, {})


@pytest.mark.parametrize("name", VALUES)
def test_an_instance_arrives_with_all_its_fields(name: str) -> None:
    """It has the same class and fields, and no code of the class ran to make it."""
    check_types("t", TYPES)
    value = VALUES[name]()
    made.clear()
    got = sent(value)
    assert type(got) is type(value)
    assert {one.name: getattr(got, one.name) for one in fields(got)} == {
        one.name: getattr(value, one.name) for one in fields(value)
    }
    assert made == []
    assert sent(got) == got


def test_a_frozen_instance_arrives_frozen() -> None:
    """Only the rebuilding may set its fields."""
    for value in (Frozen(1.0), Both(1.0)):
        with pytest.raises(FrozenInstanceError):
            sent(value).x = 2.0


@dataclass
class Cached:
    x: int

    @cached_property
    def squared(self) -> int:
        return self.x**2


def test_a_cached_property_is_computed_again() -> None:
    """Its value is no field and follows from the fields, so it is left out."""
    value = Cached(3)
    assert value.squared == 9
    got = decode(encode(value, [Cached]).frames, [Cached], {})
    assert vars(got) == {"x": 3}
    assert got.squared == 9


class Hidden:
    __slots__ = ("__cache", "note")

    def note_it(self) -> None:
        self.__cache = 1


@dataclass
class Hiding(Hidden):
    x: int = 0


def hiding() -> Hiding:
    value = Hiding()
    value.note_it()
    return value


def unset() -> Turned:
    value = Turned(1.0)
    del value.turns
    return value


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (changed(Frozen(1.0), speed=3), "Frozen has the attribute 'speed', which is no field"),
        (changed(Own(), speed=3), "Own has the attribute 'speed', which is no field"),
        (changed(Hiding(), note=3), "Hiding has the attribute 'note', which is no field"),
        (hiding(), "Hiding has the attribute '_Hidden__cache', which is no field"),
        (unset(), "a field of Turned has no value: AttributeError: .*'turns'"),
    ],
)
def test_what_would_be_lost_is_refused(value: Any, said: str) -> None:
    """An instance with more or less than its fields is not sent, and the message names the attribute."""
    with pytest.raises(BadValue, match=said):
        encode(value, [*TYPES, Hiding])


@dataclass
class OfDict(dict[str, int]):
    x: int = 0


@dataclass
class OfError(Exception):
    x: int = 0


def other(name: str) -> type:
    return dataclass(type(name, (), {"__annotations__": {"x": int}}))


class Level(IntEnum):
    LOW = 0


@pytest.mark.parametrize(
    ("types", "said"),
    [
        ((Frozen, other("Frozen")), "has two classes named Frozen; rename one of them"),
        ((int,), "<class 'int'>, which is no dataclass"),
        ((Level,), "Level'>, which is no dataclass"),
        ((Frozen(1.0),), r"Frozen\(.*, which is no dataclass"),
        (Frozen, "types= is <class .*Frozen'>; it must be a tuple of dataclasses"),
        ((OfDict,), "OfDict cannot be rebuilt from its fields: "),
        ((OfError,), "OfError cannot be rebuilt from its fields: "),
    ],
)
def test_a_class_that_cannot_be_sent_is_refused_at_the_task(types: Any, said: str) -> None:
    """The error names the task and the class."""
    with pytest.raises(ConfigError, match=f"task refused: .*{said}"):
        task("refused", size=float, types=types)(lambda number: number)


def test_a_class_may_be_listed_twice() -> None:
    """It is the same class, so nothing is mistaken."""
    check_types("t", (Frozen, Frozen))


def test_other_fields_on_the_other_side_are_refused() -> None:
    """The message names the class; no instance with fields of two versions is made."""
    older = other("Frozen")
    with pytest.raises(ProtocolError, match="the fields of dataclass Frozen differ from those on this side"):
        decode(encode(Frozen(1.0), [Frozen]).frames, [older], {})


def covered(number: float) -> float:
    return number


@dataclass
class Locked:
    x: int = 0

    def x_is(self) -> int:
        return 5


Locked.x = property(Locked.x_is)  # type: ignore[assignment]


def test_a_class_that_refuses_a_field_is_an_error_of_the_message() -> None:
    """No other exception reaches the thread that reads messages."""
    with pytest.raises(ProtocolError, match="dataclass Locked refused its fields: AttributeError"):
        decode(encode(Locked.__new__(Locked), [Locked]).frames, [Locked], {})


def test_the_source_hash_covers_dataclasses() -> None:
    """Another class, or another field in its base, is another source."""

    def hash_with(name: str, *types: type) -> str:
        task(name, size=float, types=types)(covered)
        return kind_named(name).source_hash

    hashes = [
        hash_with("covered_alone"),
        hash_with("covered_frozen", Frozen),
        hash_with("covered_two", Frozen, Slotted),
        hash_with("covered_made", other("Frozen")),
        hash_with("covered_other", dataclass(type("Frozen", (Base,), {}))),
    ]
    assert len(set(hashes)) == len(hashes)
    assert hash_with("covered_again", Frozen) == hashes[1]
