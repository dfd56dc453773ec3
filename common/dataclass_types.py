"""The dataclasses of `@task(types=...)`: which can be sent, the fields of an instance, and making it again.

Only fields cross the wire, so an instance that has anything else is refused. `wire.values` encodes fields.
"""

import dataclasses
import functools
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from offboard.common.errors import BadValue, ConfigError, describe

LAYOUTS_MAX = 256  # classes whose layout is kept


def check_types(task: str, types: tuple[type, ...]) -> None:
    """ConfigError unless these are dataclasses that can be sent, and that their names tell apart."""
    if not isinstance(types, tuple | list):
        raise ConfigError(f"task {task}: types= is {types!r:.80}; it must be a tuple of dataclasses")
    known: dict[str, type] = {}
    for one in types:
        if not (isinstance(one, type) and dataclasses.is_dataclass(one)):
            raise ConfigError(f"task {task}: types= has {one!r:.80}, which is no dataclass")
        if known.setdefault(one.__name__, one) is not one:
            raise ConfigError(f"task {task}: types= has two classes named {one.__name__}; rename one of them")
        try:
            object.__new__(one)
        except TypeError as error:  # such as a subclass of dict, whose items are no fields
            raise ConfigError(
                f"task {task}: dataclass {one.__name__} cannot be rebuilt from its fields: {error}"
            ) from error


def field_names(cls: Any) -> frozenset[str]:
    return _layout(cls).known


def fields_of(value: Any) -> dict[str, Any]:
    """The fields of an instance by name. BadValue if one has no value, or if there is more than fields."""
    cls: Any = type(value)
    layout = _layout(cls)
    try:
        fields = {name: getattr(value, name) for name in layout.names}
    except Exception as error:
        raise BadValue(f"a field of {cls.__name__} has no value: {describe(error)}") from error
    own = getattr(value, "__dict__", ())
    if layout.slots or not layout.known.issuperset(own):
        for name in (*own, *layout.slots):
            if name in layout.known or not hasattr(value, name):
                continue
            if not isinstance(inspect.getattr_static(cls, name, None), functools.cached_property):
                raise BadValue(f"{cls.__name__} has the attribute {name!r}, which is no field")
    return fields


def rebuilt(cls: type, fields: Mapping[str, Any]) -> Any:
    """An instance with these fields. `__init__` does not run again: the values are those that it left."""
    made: Any = object.__new__(cls)
    for name, value in fields.items():
        object.__setattr__(made, name, value)
    return made


@dataclass(frozen=True, slots=True)
class _Layout:
    """The names of the fields, and the slots of an instance that are no fields."""

    names: tuple[str, ...]
    known: frozenset[str]
    slots: tuple[str, ...]


@functools.lru_cache(LAYOUTS_MAX)
def _layout(cls: Any) -> _Layout:
    names = tuple(one.name for one in dataclasses.fields(cls))
    members = [
        name for base in cls.__mro__ for name, one in vars(base).items() if inspect.ismemberdescriptor(one)
    ]
    return _Layout(names, frozenset(names), tuple(name for name in members if name not in names))
