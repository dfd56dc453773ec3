"""What counts as the source of a task: its hash, and what `@task(version=..., covers=...)` adds to it."""

import inspect
import logging
import os
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from offboard.common.dataclass_types import field_names
from offboard.common.errors import ConfigError
from offboard.common.security.plain_files import check_plain
from offboard.common.source.normal_form import function_of, normal_form

if TYPE_CHECKING:
    import hashlib

PIECE_BYTES = 1024 * 1024
FILE_BYTES_MAX = 64 * 1024**3  # a larger file is read for minutes
COVERS_MAX = 64  # functions, classes and files of one task, or of one of its variants
VERSION_LENGTH_MAX = 64
HASH_LENGTH = 64  # characters; the hash of covered files follows that of the source

Packing = tuple[Callable[..., Any] | None, ...]  # pack and unpack, and what runs requests together

log = logging.getLogger(__name__)


class CoveredFiles:
    """The files at `paths` that `task` covers. Any thread may call any method.

    `digest`: the SHA-256 of their contents in this order, empty until all are read.
    `fault`: why they cannot be read; empty if nothing is wrong. `lacking`: this computer need not have them,
    and does not.
    """

    def __init__(self, task: str, paths: Sequence[Path]) -> None:
        self.paths = tuple(paths)
        self.digest = self.fault = ""
        self.lacking = False
        self._task = task
        self._lock = threading.Lock()
        self._reader: threading.Thread | None = None

    def begin(self, *, needed: bool = True) -> None:
        """Begin to read in a thread, once. ConfigError if a file that is `needed` cannot be opened."""
        with self._lock:
            if self._reader is not None or (self.lacking and not needed):
                return
            try:
                for path in self.paths:
                    self._check(path)
            except ConfigError:
                if needed:
                    raise
                self.lacking = True
                return
            self.lacking = False
            self._reader = threading.Thread(target=self._read, name=f"covers-{self._task}", daemon=True)
            try:
                self._reader.start()
            except RuntimeError:  # the system has no thread left
                self._read()

    @property
    def reading(self) -> bool:
        return self._reader is not None and not self.digest and not self.fault

    def read(self, *, needed: bool = True) -> None:
        """Read them, and wait until that is done. ConfigError if a file that is `needed` cannot be read."""
        self.begin(needed=needed)
        if self._reader is not None and self.reading:
            self._reader.join()
        if self.fault and needed:
            raise ConfigError(self.fault)

    def _check(self, path: Path) -> None:
        try:
            check_plain(path, link=True)
            with path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
        except OSError as error:
            raise self._wrong(path, error.strerror) from error
        if size > FILE_BYTES_MAX:
            raise self._too_large(path)

    def _read(self) -> None:
        import hashlib  # it loads OpenSSL, which --help does not need

        whole = hashlib.sha256()
        try:
            for path in self.paths:
                whole.update(self._digest(path, hashlib.sha256()))
        except ConfigError as error:
            self.fault = str(error)
            text = "%s: this task stays onboard; remedy: repair the file, and start again"
            log.warning(text, error)
        else:
            self.digest = whole.hexdigest()

    def _digest(self, path: Path, found: "hashlib._Hash") -> bytes:
        count = 0
        try:
            with path.open("rb", buffering=0) as file:
                while piece := file.read(PIECE_BYTES):
                    found.update(piece)
                    count += len(piece)
                    if count > FILE_BYTES_MAX:
                        raise self._too_large(path)
        except OSError as error:
            raise self._wrong(path, error.strerror) from error
        return found.digest()

    def _too_large(self, path: Path) -> ConfigError:
        return self._wrong(path, f"over {FILE_BYTES_MAX / 1024**3:g} GiB; use version= for such a file")

    def _wrong(self, path: Path, why: str | None) -> ConfigError:
        return ConfigError(f"task {self._task}: covers= names {path}: {why}")


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
    """What a task covers; paths are relative to the file of `function`. ConfigError names a wrong part."""
    if isinstance(version, bool) or not isinstance(version, str | int):
        raise ConfigError(f"task {task}: version= is {version!r:.80}; it must be a text or a whole number")
    if len(shown := str(version)) > VERSION_LENGTH_MAX:
        raise ConfigError(f"task {task}: version= has over {VERSION_LENGTH_MAX} characters")
    return Covers(shown, *_split(task, function, covers))


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


def source_hash(
    function: Callable[..., Any],
    setup: Callable[[], Any] | None,
    types: Iterable[type],
    packing: Packing,
    *,
    covers: Covers,
) -> str:
    """SHA-256 of the source of a function, its setup, its dataclasses with their fields, its packing, and
    what it covers, but for the contents of files.

    An empty text, which matches nothing, if the function has no source.
    """
    own = normal_form(function)
    if not own:
        return ""
    return _hash([own, normal_form(setup), *_sources(types, packing), *covers.texts()])


def contract_hash(
    signature: inspect.Signature, types: Iterable[type], packing: Packing, *, covers: Covers
) -> str:
    """SHA-256 of what all variants of a task share: what a caller gives, dataclasses, packing, covers.

    Defaults do not count: the robot fills them in.
    """
    given = [f"{one.kind.name} {one.name}" for one in signature.parameters.values()]
    return _hash(["variants", *given, *_sources(types, packing), *covers.texts()])


def _sources(types: Iterable[type], packing: Packing) -> list[str]:
    parts = [part for one in types for part in (normal_form(one), *sorted(field_names(one)))]
    return parts + [normal_form(one) for one in packing if one is not None]


def _hash(parts: Iterable[str]) -> str:
    import hashlib  # it loads OpenSSL, which --help does not need

    return hashlib.sha256("\0".join(parts).encode()).hexdigest()
