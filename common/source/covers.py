"""What `@task(version=..., covers=...)` adds to the source of a task: a version, functions, classes, files.

How files are read is in `covered_files`.
"""

import inspect
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError
from offboard.common.source.covered_files import CoveredFiles
from offboard.common.source.normal_form import function_of, normal_form

COVERS_MAX = 64  # functions, classes and files of one task, or of one of its variants
VERSION_LENGTH_MAX = 64


@dataclass(frozen=True, slots=True)
class Covers:
    """What a task covers. `code` are functions and classes, `files` is None if there are none."""

    version: str = ""
    code: tuple[Any, ...] = ()
    files: CoveredFiles | None = None

    def texts(self) -> list[str]:
        """What the hash of the source gets; the contents of files have a hash of their own."""
        count = 0 if self.files is None else len(self.files.paths)
        texts = [f"version {self.version}"] if self.version else []
        return texts + [f"covers {normal_form(one)}" for one in self.code] + [f"{count} files"] * bool(count)


def covers_of(task: str, function: Callable[..., Any], *, version: object, covers: object) -> Covers:
    """What a task covers. ConfigError names what cannot be covered.

    Paths are relative to the file of `function`.
    """
    return Covers(_checked_version(task, version), *_split(task, function, covers))


def covers_by_site(
    task: str, function: Callable[..., Any], *, covers: object, sites: Mapping[str, object]
) -> dict[str, Covers]:
    """What the variant of each of the `sites` covers; nothing unless `covers` is a dictionary by site."""
    by_site: Mapping[Any, object] = covers if isinstance(covers, Mapping) else {}
    for site in by_site:
        if site not in sites:
            known = ", ".join(sites) or "no site: a dictionary needs variants="
            raise ConfigError(f"task {task}: covers= names the site {site!r:.80}; the task has {known}")
    return {site: Covers("", *_split(task, function, by_site.get(site, ()))) for site in sites}


def _checked_version(task: str, version: object) -> str:
    if isinstance(version, bool) or not isinstance(version, str | int):
        raise ConfigError(f"task {task}: version= is {version!r:.80}; it must be a text or a whole number")
    if len(shown := str(version)) > VERSION_LENGTH_MAX:
        raise ConfigError(f"task {task}: version= has over {VERSION_LENGTH_MAX} characters")
    return shown


def _split(
    task: str, function: Callable[..., Any], covers: object
) -> tuple[tuple[Any, ...], CoveredFiles | None]:
    """The functions and classes, and the files."""
    if not isinstance(covers, tuple | list):
        allowed = "a tuple of functions, classes and paths of files"
        raise ConfigError(f"task {task}: covers= is {covers!r:.80}; it must be {allowed}")
    if len(covers) > COVERS_MAX:
        raise ConfigError(f"task {task}: covers= has {len(covers)} items; at most {COVERS_MAX} are allowed")
    paths = [_folder(function) / one for one in covers if isinstance(one, str | os.PathLike)]
    code = tuple(one for one in covers if not isinstance(one, str | os.PathLike))
    for one in code:
        if not callable(one):
            raise ConfigError(f"task {task}: covers= has {one!r:.80}, no function, class or path of a file")
        if not normal_form(one):
            raise ConfigError(f"task {task}: covers= has {one!r:.80}, whose source cannot be read")
    return code, CoveredFiles(task, paths) if paths else None


def _folder(function: Callable[..., Any]) -> Path:
    try:
        return Path(inspect.getfile(function_of(function))).absolute().parent
    except (OSError, TypeError):
        return Path.cwd()
