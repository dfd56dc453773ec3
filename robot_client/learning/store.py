"""A warm restart: what was learnt outlives the process in a file.

Kept are observations, not what a predictor made of them: whatever is configured then learns them again.
What is in the file is `memory_file`'s business.
"""

import contextlib
import logging
import math
import os
import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path

from offboard.common.errors import ConfigError
from offboard.robot_client.learning import memory_file
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.memory_file import PER_SIZE, PER_WORK, KeptKind, KeptSite, Unreadable
from offboard.robot_client.learning.site import Observation
from offboard.robot_client.policies.probe import STALE

SAVE_EVERY_S = 30.0  # at most, between the first task and the end
WRITE_WAIT_S = 5.0  # for a disk at the end
HALF_LIFE_S = 3600.0  # of what is believed, while the process is away
OBSERVATIONS_MIN = 5  # of a site; with fewer it starts knowing nothing
FILE_BYTES_MAX = 64 * 1024 * 1024

log = logging.getLogger(__name__)


class Store:
    """The memory of one robot, in the file at `path`; `now` tells Unix time.

    A file that cannot be read, or not be written, is a warning: the robot starts cold, or goes on without.
    `recall`, `due` and `snapshot` are called under the offloader's lock; files are written by a thread.
    """

    def __init__(self, path: Path, *, now: Callable[[], float] = time.time) -> None:
        self.path = path
        self._now = now
        self._due_s: float | None = None
        self._writer: threading.Thread | None = None
        self._failed = False
        if path.is_dir():
            raise ConfigError(f"memory {path}: is a folder")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"memory {path}: {error.strerror}") from error
        self._kept = self._read()  # of kinds that were not asked for yet
        self._away: dict[str, dict[str, KeptSite]] = {}  # of sites that this robot has not, by kind

    def recall(self, memory: KindMemory, sites: Collection[str]) -> None:
        """Teach a new memory what is kept of its kind on these sites."""
        kind = memory.kind
        kept = self._kept.pop(kind.name, None)
        if kept is None:
            return
        if not kind.source_hash or kept.source != kind.source_hash:
            log.info("memory %s: the source of task %s has changed: it starts cold", self.path, kind.name)
            return
        for size, work in kept.worked:
            memory.learn_size(size, work)
        for name, site in kept.sites.items():
            if name not in sites:
                self._away.setdefault(kind.name, {})[name] = site
            elif observations := _as_learnt(self._believed(site), kept.per, memory.per_work):
                memory.site(name).recall(observations, age=STALE)
                log.info("%s on %s: %d observations recalled", kind.name, name, len(observations))

    def due(self, now_s: float) -> bool:
        """Whether to save now: SAVE_EVERY_S after the last time, unless that still goes on."""
        if self._due_s is None:
            self._due_s = now_s + SAVE_EVERY_S
        if now_s < self._due_s or self._writing():
            return False
        self._due_s = now_s + SAVE_EVERY_S
        return True

    def snapshot(self, memories: Mapping[str, KindMemory]) -> dict[str, KeptKind]:
        """All that is to be in the file, as it is now."""
        now, live = self._now(), dict[str, KeptKind]()
        for name, memory in memories.items():
            sites = dict(self._away.get(name, {}))
            for site, learnt in memory.sites.items():
                if learnt.observations:
                    sites[site] = KeptSite(now, tuple(learnt.observations))
            per = PER_WORK if memory.per_work else PER_SIZE
            live[name] = KeptKind(memory.kind.source_hash, per, tuple(memory.worked), sites)
        return self._kept | live

    def save_soon(self, kinds: Mapping[str, KeptKind]) -> None:
        """Write the file, without making anybody wait."""
        writer = threading.Thread(target=self._write, args=(kinds,), name="memory", daemon=True)
        try:
            writer.start()
        except RuntimeError as error:  # no thread is to be had
            self._warn(str(error))
        else:
            self._writer = writer

    def save_last(self, kinds: Mapping[str, KeptKind]) -> None:
        """Write the file, after whatever is being written; a disk that hangs is not waited for longer."""
        if self._writer is not None:
            self._writer.join(WRITE_WAIT_S)
        if not self._writing():
            self.save_soon(kinds)
            if self._writer is not None:
                self._writer.join(WRITE_WAIT_S)
        if self._writing():
            log.warning("memory %s: not written within %g s", self.path, WRITE_WAIT_S)

    def _writing(self) -> bool:
        return self._writer is not None and self._writer.is_alive()

    def _believed(self, site: KeptSite) -> tuple[Observation, ...]:
        """The newest of a site's observations, half as many for each HALF_LIFE_S away."""
        away_s = max(0.0, self._now() - site.saved_at)  # a clock set back says nothing of it
        count = math.ceil(len(site.observations) * 2 ** (-away_s / HALF_LIFE_S))
        return site.observations[-count:] if count >= OBSERVATIONS_MIN else ()

    def _write(self, kinds: Mapping[str, KeptKind]) -> None:
        try:
            replace_file(self.path, memory_file.encode(kinds))
            self._failed = False
        except OSError as error:
            self._warn(error.strerror)

    def _warn(self, why: str | None) -> None:
        """Once, until it is written again."""
        if not self._failed:
            log.warning("memory %s cannot be written: %s; tasks go on", self.path, why)
        self._failed = True

    def _read(self) -> dict[str, KeptKind]:
        try:
            with self.path.open("rb") as file:
                text = file.read(FILE_BYTES_MAX + 1)
            if len(text) > FILE_BYTES_MAX:
                raise Unreadable(f"over {FILE_BYTES_MAX} bytes")
            return memory_file.decode(text)
        except FileNotFoundError:
            return {}
        except (OSError, Unreadable) as error:
            reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
            log.warning("memory %s: %s; starting cold, %s", self.path, reason, self._set_aside())
            return {}

    def _set_aside(self) -> str:
        """Keep the first file that could not be read; what became of it, in words."""
        aside = self.path.with_name(f"{self.path.name}.unreadable")
        if aside.exists():
            return f"it will be replaced: {aside} is there already"
        try:
            self.path.rename(aside)
        except OSError as error:
            return f"it will be replaced: it cannot be renamed: {error.strerror}"
        return f"the file is now {aside}"


def replace_file(path: Path, text: bytes) -> None:
    """Atomically: whoever reads `path`, also after a crash, finds the old text or the new one, whole."""
    fresh = path.with_name(f".{path.name}.new")
    try:
        with fresh.open("wb") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            fresh.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _as_learnt(observations: Collection[Observation], saved_per: str, per_work: bool) -> list[Observation]:
    """In the amounts that the memory learns now; what nobody told the work of is left out."""
    if not per_work:
        return [_with_amount(one, one.size) for one in observations]
    if saved_per == PER_WORK:
        return list(observations)
    return [_with_amount(one, one.work) for one in observations if one.work is not None]


def _with_amount(one: Observation, amount: float) -> Observation:
    return one if one.amount == amount else replace(one, amount=amount)
