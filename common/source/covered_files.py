"""The files that count as the source of a task, such as a model: a thread reads them once, in pieces.

What else counts is in `covers`; `source_hash` makes one hash of the rest.
"""

import logging
import os
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from offboard.common.errors import ConfigError
from offboard.common.security.plain_files import check_plain

if TYPE_CHECKING:
    import hashlib

PIECE_BYTES = 1024 * 1024
FILE_BYTES_MAX = 64 * 1024**3  # a larger file is read for minutes

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
