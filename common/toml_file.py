"""Reads TOML files that people write; errors name the file, the line and the nearest known key."""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from offboard.common.errors import DataError


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of the file, or a DataError that names the file and the line."""
    try:
        return parse_toml(path, path.read_bytes())
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}") from error


def parse_toml(path: Path, text: bytes) -> dict[str, Any]:
    if sys.version_info >= (3, 11):  # not at the top: --help reads no file
        import tomllib
    else:
        import tomli as tomllib

    try:
        return tomllib.loads(text.decode())
    except (ValueError, RecursionError) as error:  # a number may be too long, and a list too deep
        raise DataError(f"{path}: {error}") from error


def unknown_key(path: Path, key: str, known: Sequence[str]) -> DataError:
    """The error for a key that is not `known`; it names the line and the nearest known key."""
    starts = (key, f"[{key}", f"[[{key}")
    lines = enumerate(path.read_text().splitlines(), 1)
    line = next((number for number, text in lines if text.strip().startswith(starts)), 1)
    return DataError(f"{path}:{line}: {unknown('key', key, known)}")


def unknown(what: str, name: str, known: Sequence[str]) -> str:
    """Text for a name that is not `known`: the nearest known one, or all of them if none is near."""
    near = nearest(name, known)
    hint = f"did you mean {near!r}?" if near else f"known: {', '.join(sorted(known))}"
    return f"unknown {what} {name!r}; {hint}"


def nearest(name: str, known: Sequence[str]) -> str | None:
    """The known name that looks most like `name`, if one does."""
    import difflib  # loaded only after a mistake

    return next(iter(difflib.get_close_matches(name, known, n=1)), None)


def line_of(lines: Sequence[str], table: str, number: int, key: str) -> int:
    """The line of `key` in the n-th [table] or [[table]]; that of the table if the key is not found there."""
    starts = [n for n, text in enumerate(lines, 1) if re.match(rf"\s*\[\[?\s*{table}\s*\]", text)]
    first = starts[number - 1] if 0 < number <= len(starts) else 1
    tables = [n for n, text in enumerate(lines, 1) if re.match(r"\s*\[", text) and n > first]
    named = re.compile(rf"(?<![\w-])[\"']?{re.escape(key)}[\"']?\s*[=.\]]")
    last = min(tables, default=len(lines) + 1) - 1
    return next((n for n in range(first, last + 1) if named.search(lines[n - 1])), first)
