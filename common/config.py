"""The settings of a process: a frozen dataclass, filled from flags, environment, TOML file and defaults."""

import argparse
import dataclasses
import functools
import importlib
import math
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from offboard.common.errors import ConfigError, DataError, describe
from offboard.common.toml_file import read_toml, unknown_key

C = TypeVar("C")
MODULE_CLASS = "MODULE.CLASS"

REQUIRED: Any = dataclasses.MISSING


def setting(
    default: Any,
    help: str,
    *,
    group: str = "options",
    rare: bool = False,
    name: str | None = None,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[str] | None = None,
    metavar: str | None = None,
) -> Any:
    """One field of a config dataclass.

    `group` is the heading of the flag in the help; a `rare` flag is shown by --help-all only. `name` is the
    name of the flag if it differs from the name of the field.
    """
    shown = {"help": help, "group": group, "rare": rare, "name": name, "metavar": metavar}
    bounds = {"minimum": minimum, "maximum": maximum, "choices": choices}
    return dataclasses.field(default=default, metadata=shown | bounds)


def check(config: Any, dashes: str = "--") -> None:
    """Raise a ConfigError that names the first value out of bounds. Call it in `__post_init__`."""
    for field in settings_of(type(config)):
        _check_value(dashes + (flag_of(field) if dashes else field.name), field, getattr(config, field.name))


def part_of(cls: type[C], config: Any, **others: Any) -> C:
    """The `cls` with the values that another dataclass has for the same fields, and with `others`."""
    return cls(**{name: getattr(config, name) for name in _names(cls) & _names(config)} | others)


def _names(of: Any) -> set[str]:
    return {field.name for field in dataclasses.fields(of)}


def resolve(cls: type[C], flags: argparse.Namespace, *, environ: Mapping[str, str], prefix: str) -> C:
    """Build a checked `cls` from parsed flags, then `PREFIX_NAME` in `environ`, then the file of --config."""
    config = getattr(flags, "config", None)
    known = [flag_of(field) for field in settings_of(cls)]
    from_file = {} if config is None else _known(config, read_toml(config), known)
    values: dict[str, Any] = {}
    for field in settings_of(cls):
        name = flag_of(field)
        variable = f"{prefix}_{name.upper().replace('-', '_')}"
        flag = getattr(flags, field.name, None)
        if flag is not None:
            values[field.name] = _convert(f"--{name}", field, cls, flag)
        elif environ.get(variable, "") != "":
            values[field.name] = _convert(variable, field, cls, environ[variable])
        elif name in from_file:
            values[field.name] = _convert(f"{config}: {name}", field, cls, from_file[name])
        elif field.default is REQUIRED:
            raise ConfigError(f"--{name} is missing: {field.metadata['help']}")
    return cls(**values)


def from_table(cls: type[C], table: Mapping[str, Any], path: Path, section: str) -> C:
    """Build `cls` from one table of a TOML file, whose keys are the names of the flags with _ instead of -.

    An unknown key or a wrong value is a DataError that names the file and the key.
    """
    fields = {flag_of(field).replace("-", "_"): field for field in settings_of(cls)}
    _known(path, table, list(fields))
    try:
        values = {
            field.name: _convert(f"{section}.{name}", field, cls, table[name])
            for name, field in fields.items()
            if name in table or field.default is REQUIRED
        }
        return cls(**values)
    except KeyError as missing:
        raise DataError(f"{path}: {section}.{missing.args[0]} is missing") from None
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from error


def as_dict(config: Any) -> dict[str, Any]:
    """The values by the names of their flags, for the log line at start and for `/config`."""
    return {flag_of(f): _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}


def settings_of(cls: type) -> list[dataclasses.Field[Any]]:
    """The fields of `cls` that were made by `setting`."""
    return [f for f in dataclasses.fields(cls) if f.metadata]


def flag_of(field: dataclasses.Field[Any]) -> str:
    """The name of the flag of a field, without its dashes."""
    return field.metadata.get("name") or field.name.replace("_", "-")


def type_of(field: dataclasses.Field[Any], cls: type) -> tuple[type, bool]:
    """The type of one value of the field, and whether the field takes many (`tuple[T, ...]`)."""
    hint = _hints(cls)[field.name]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        hint = next(arg for arg in typing.get_args(hint) if arg is not type(None))
    if typing.get_origin(hint) is tuple:
        return typing.get_args(hint)[0], True
    return hint, False


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _convert(where: str, field: dataclasses.Field[Any], cls: type, value: Any) -> Any:
    base, many = type_of(field, cls)
    if many:
        items = value.split(",") if isinstance(value, str) else value
        if not isinstance(items, list):
            raise ConfigError(f"{where}: {value!r} is not a list")
        parts = [part for item in items for part in (item.split(",") if isinstance(item, str) else [item])]
        converted: Any = tuple(_convert_one(where, base, part) for part in parts)
    else:
        converted = _convert_one(where, base, value)
    _check_value(where, field, converted)
    return converted


def _convert_one(where: str, base: type, value: Any) -> Any:
    text = str(value).strip()
    if base is bool:
        if text.lower() in ("1", "true", "yes", "on"):
            return True
        if text.lower() in ("0", "false", "no", "off"):
            return False
        raise ConfigError(f"{where}: {text!r} is neither true nor false")
    try:
        return base(text)
    except ValueError:
        wanted = {int: "a whole number", float: "a number"}.get(base, base.__name__)
        raise ConfigError(f"{where}: {text!r} is not {wanted}") from None


def _check_value(where: str, field: dataclasses.Field[Any], value: Any) -> None:
    low, high = field.metadata["minimum"], field.metadata["maximum"]
    choices = field.metadata["choices"]
    for item in value if isinstance(value, tuple) else (value,):
        if item is None:
            continue
        if choices and item not in choices:
            raise ConfigError(f"{where}: {item!r} is not one of {', '.join(choices)}")
        if low is not None and not item >= low:
            raise ConfigError(f"{where}: {item} is below {low:g}, the minimum")
        if high is not None and not item <= high:
            raise ConfigError(f"{where}: {item} is above {high:g}, the maximum")
        if isinstance(item, float) and not math.isfinite(item):
            raise ConfigError(f"{where}: {item} is not a finite number")


def _known(path: Path, table: Mapping[str, Any], known: Sequence[str]) -> Mapping[str, Any]:
    """The table, if each of its keys is the name of a setting."""
    for key in table:
        if key not in known:
            raise unknown_key(path, key, known)
    return table


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else list(value) if isinstance(value, tuple) else value


def find_class(path: str, what: str) -> Any:
    """The class that MODULE.CLASS names; ConfigError, which says `what` it should be, if there is none."""
    module, _, name = path.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ConfigError:  # such as a missing extra
        raise
    except (Exception, SystemExit) as error:
        why = f"module {module!r} cannot be imported: {describe(error)}"
        raise ConfigError(f"{what} {path!r}: {why}") from error
    if not callable(found):
        raise ConfigError(f"{what} {path!r}: module {module!r} has no class {name!r}")
    return found
