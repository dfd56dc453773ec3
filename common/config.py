"""Settings of a process: a frozen dataclass filled from flag, environment, TOML file, default, in that order.

What the settings are is the business of each process's own `config.py`.
"""

import argparse
import dataclasses
import functools
import os
import re
import sys
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from offboard.common.errors import ConfigError, DataError, OffloadError

C = TypeVar("C")

REQUIRED: Any = dataclasses.MISSING
COLUMNS = 80  # of help, where no terminal says
INTERRUPTED_EXIT, BROKEN_PIPE_EXIT = 130, 141  # as a shell counts them: 128 + the signal


def setting(
    default: Any,
    help: str,
    *,
    name: str | None = None,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[str] | None = None,
    metavar: str | None = None,
) -> Any:
    """One field of a config dataclass; `name` is the flag where it is not the field's own name."""
    metadata = {"help": help, "name": name, "metavar": metavar}
    bounds = {"minimum": minimum, "maximum": maximum, "choices": choices}
    return dataclasses.field(default=default, metadata=metadata | bounds)


def check(config: Any) -> None:
    """Call from `__post_init__`: every value is within its bounds, or ConfigError names it."""
    for field in dataclasses.fields(config):
        if field.metadata:
            _check_value(f"--{_flag(field)}", field, getattr(config, field.name))


def load(
    cls: type[C],
    argv: Sequence[str],
    *,
    prog: str,
    description: str,
    environ: Mapping[str, str],
    prefix: str,
) -> C:
    """Build `cls` from `argv`, then `PREFIX_NAME` in `environ`, then the TOML file of `--config`."""
    parser = CommandParser(prog=prog, description=description)
    add_flags(parser, cls, prefix)
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML file with the same names")
    return resolve(cls, parser.parse_args(argv), environ=environ, prefix=prefix)


def resolve(cls: type[C], flags: argparse.Namespace, *, environ: Mapping[str, str], prefix: str) -> C:
    """Merge parsed flags, environment and the `--config` file into one checked `cls`."""
    from_file = _read_toml(getattr(flags, "config", None), cls)
    values: dict[str, Any] = {}
    for field in _settings(cls):
        name = _flag(field)
        variable = f"{prefix}_{name.upper().replace('-', '_')}"
        flag = getattr(flags, field.name, None)
        if flag is not None:
            values[field.name] = _convert(f"--{name}", field, cls, flag)
        elif environ.get(variable, "") != "":
            values[field.name] = _convert(variable, field, cls, environ[variable])
        elif name in from_file:
            values[field.name] = _convert(f"{flags.config}: {name}", field, cls, from_file[name])
        elif field.default is REQUIRED:
            raise ConfigError(f"--{name} is missing: {field.metadata['help']}")
    return cls(**values)


def from_table(cls: type[C], table: Mapping[str, Any], path: Path, section: str) -> C:
    """Fill `cls` from one table of a TOML file, whose keys are the flags with _ for -.

    Unknown keys and wrong values name file and key.
    """
    fields = {_flag(field).replace("-", "_"): field for field in _settings(cls)}
    for key in table:
        if key not in fields:
            raise unknown_key(path, key, list(fields))
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


def add_flags(parser: argparse.ArgumentParser, cls: type, prefix: str) -> None:
    """One flag a setting; values stay text until `resolve` converts them."""
    parser.epilog = f"Each flag can also be given in the environment, --one-flag as {prefix}_ONE_FLAG."
    for field in _settings(cls):
        help = field.metadata["help"]
        if field.default is not REQUIRED and not _obvious(field.default):
            help += f" (default: {_shown(field.default)})"
        parser.add_argument(
            f"--{_flag(field)}",
            dest=field.name,
            help=help.replace("%", "%%"),
            **_shape(field, cls),
        )


def as_dict(config: Any) -> dict[str, Any]:
    """The resolved settings under their flag names, for the log line at start and `/config`."""
    return {_flag(f): _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}


def unknown_key(path: Path, key: str, known: Sequence[str]) -> DataError:
    """The error for a TOML key nobody reads: file, line and the nearest key that is read."""
    starts = (key, f"[{key}", f"[[{key}")
    lines = enumerate(path.read_text().splitlines(), 1)
    line = next((number for number, text in lines if text.strip().startswith(starts)), 1)
    return DataError(f"{path}:{line}: {unknown('key', key, known)}")


def unknown(what: str, name: str, known: Sequence[str]) -> str:
    """What to say of a name nobody knows: the nearest that is known, or all of them."""
    import difflib  # what only a mistake needs is loaded where one was made

    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(sorted(known))}"
    return f"unknown {what} {name!r}; {hint}"


def line_of(lines: Sequence[str], table: str, number: int, key: str) -> int:
    """Line of a key of the n-th [[table]] of a TOML file; of that table where it is not found in it."""
    starts = [n for n, text in enumerate(lines, 1) if re.match(rf"\s*\[\[\s*{table}\s*\]\]", text)]
    first = starts[number - 1] if 0 < number <= len(starts) else 1
    tables = [n for n, text in enumerate(lines, 1) if re.match(r"\s*\[", text) and n > first]
    named = re.compile(rf"(?<![\w-])[\"']?{re.escape(key)}[\"']?\s*[=.\]]")
    last = min(tables, default=len(lines) + 1) - 1
    return next((n for n in range(first, last + 1) if named.search(lines[n - 1])), first)


def read_toml(path: Path) -> dict[str, Any]:
    """The file's tables, or DataError naming file and line."""
    import tomllib

    try:
        return tomllib.loads(path.read_text())
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DataError(f"{path}: {getattr(error, 'strerror', None) or error}") from error


class CommandParser(argparse.ArgumentParser):
    """argparse that says what is wrong in one line, exit code 2."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**({"formatter_class": _Help} | settings))

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


class _Help(argparse.HelpFormatter):
    """As wide as the terminal, without shutil, which loads three compressors to tell it."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=_columns() - 2)


class RawHelp(_Help, argparse.RawDescriptionHelpFormatter):
    """The same, where the description has its own lines."""


def _columns() -> int:
    told = os.environ.get("COLUMNS", "")
    if told.isdecimal() and int(told) > 0:
        return int(told)
    try:
        return os.get_terminal_size(1).columns or COLUMNS
    except OSError:  # no terminal
        return COLUMNS


def run_command(prog: str, command: Callable[[], int]) -> int:
    """Run a console command; a user's mistake is one line and 2, a failed run one line and 1."""
    try:
        code = command()
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE_EXIT
    except (ConfigError, DataError) as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 2
    except OffloadError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{prog}: interrupted", file=sys.stderr)
        return INTERRUPTED_EXIT


def _settings(cls: type) -> list[dataclasses.Field[Any]]:
    return [f for f in dataclasses.fields(cls) if f.metadata]


def _flag(field: dataclasses.Field[Any]) -> str:
    return field.metadata.get("name") or field.name.replace("_", "-")


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _base_type(field: dataclasses.Field[Any], cls: type) -> tuple[type, bool]:
    """The field's plain type, and whether it takes many values (`tuple[T, ...]`)."""
    hint = _hints(cls)[field.name]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        hint = next(arg for arg in typing.get_args(hint) if arg is not type(None))
    if typing.get_origin(hint) is tuple:
        return typing.get_args(hint)[0], True
    return hint, False


def _obvious(default: Any) -> bool:
    """Nothing that --help need say."""
    return default is None or default is False or default == ()


def _shape(field: dataclasses.Field[Any], cls: type) -> dict[str, Any]:
    """How a flag is written: --name VALUE, again for each of a list, --name or --no-name for a fact."""
    base, many = _base_type(field, cls)
    if base is bool:
        return {"action": argparse.BooleanOptionalAction}
    metavar = field.metadata["metavar"] or "|".join(field.metadata["choices"] or ())
    metavar = metavar or {int: "K", float: "X", Path: "FILE"}.get(base, "TEXT")
    return {"metavar": metavar, "action": "append" if many else "store"}


def _convert(where: str, field: dataclasses.Field[Any], cls: type, value: Any) -> Any:
    base, many = _base_type(field, cls)
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
            raise ConfigError(f"{where}: {item} is below {low:g}, the least allowed")
        if high is not None and not item <= high:
            raise ConfigError(f"{where}: {item} is above {high:g}, the most allowed")


def _read_toml(path: Path | None, cls: type) -> dict[str, Any]:
    if path is None:
        return {}
    table = read_toml(path)
    known = [_flag(field) for field in _settings(cls)]
    for key in table:
        if key not in known:
            raise unknown_key(path, key, known)
    return table


def _shown(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else list(value) if isinstance(value, tuple) else value
