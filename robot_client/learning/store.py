"""The memory file: what was learnt outlives the process, so that a restart is warm.

Observations are kept, not what a predictor made of them, so that any predictor can learn them again.
The content of the file is defined in `memory_file`.
"""

import logging
import math
import os
import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path

from offboard.common.errors import ConfigError
from offboard.common.security.plain_files import check_plain, replace_file
from offboard.common.tasks import Size
from offboard.robot_client.learning import memory_file
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.learning.memory_file import PER_SIZE, PER_WORK, KeptKind, KeptSite, Unreadable
from offboard.robot_client.learning.site import Observation
from offboard.robot_client.policies.probe import PROBE_EVERY
from offboard.robot_client.predictors.base import WARM_UP

SAVE_EVERY_S = 30.0  # while tasks run; the file is also saved at the end
WRITE_WAIT_S = 5.0  # that the end of the process waits for a slow disk
HALF_LIFE_S = 3600.0  # without the process: after this time, half as many observations are recalled
FILE_BYTES_MAX = 64 * 1024 * 1024  # of a memory file, so that a wrong file does not fill the memory

log = logging.getLogger(__name__)


class Store:
    """The memory of one robot, in the file at `path`; `now` returns the Unix time in seconds.

    If the file cannot be read, the robot starts cold; if it cannot be written, tasks go on. Both are logged.
    A thread writes the file.
    All but `save_soon` and `save_last` is called under the offloader's lock.
    """

    def __init__(self, path: Path, *, now: Callable[[], float] = time.time) -> None:
        self.path = path
        self._now = now
        self._due_s: float | None = None
        self._writer: threading.Thread | None = None
        self._failed = False
        try:
            check_plain(path)
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"memory {path}: {error.strerror}") from error
        self._kept = self._read()  # kinds that this process has not run yet
        self._away: dict[str, KeptKind] = {}  # sites that this robot has not had yet, by kind

    def recall(self, memory: KindMemory, sites: Collection[str]) -> None:
        """Teach a memory what is kept of its kind and of those of these sites that it did not have yet."""
        kind = memory.kind
        if kind.name in self._kept:
            self._begin(memory, self._kept.pop(kind.name))
        kept = self._away.get(kind.name)
        if kept is None:
            return
        for name in [name for name in kept.sites if name in sites]:
            site = kept.sites.pop(name)
            if not site.source == kind.at(name).fingerprint != "":
                text = "memory %s: %s on %s starts cold: the source of its variant has changed or is not here"
                log.info(text, self.path, kind.name, name)
            elif observations := _as_learnt(self._believed(site), kept.per, memory.per_work):
                memory.site(name).recall(observations, age=PROBE_EVERY)
                log.info("%s on %s: %d observations recalled", kind.name, name, len(observations))

    def _begin(self, memory: KindMemory, kept: KeptKind) -> None:
        kind = memory.kind
        if not kind.fingerprint or kept.source != kind.fingerprint:
            log.info("memory %s: task %s starts cold because its source has changed", self.path, kind.name)
            return
        if not _fits(kept, kind.size_count):
            log.info("memory %s: task %s starts cold: its sizes had another count", self.path, kind.name)
            return
        for size, work in kept.worked:
            memory.learn_size(size, work)
        self._away[kind.name] = kept

    def due(self, now_s: float) -> bool:
        """Whether to save now: SAVE_EVERY_S after the last save, unless that one is still being written."""
        if self._due_s is None:
            self._due_s = now_s + SAVE_EVERY_S
        if now_s < self._due_s or self._writing():
            return False
        self._due_s = now_s + SAVE_EVERY_S
        return True

    def snapshot(self, memories: Mapping[str, KindMemory]) -> dict[str, KeptKind]:
        """What the file should contain now."""
        now, live = self._now(), dict[str, KeptKind]()
        for name, memory in memories.items():
            sites = dict(self._away[name].sites) if name in self._away else {}
            for site, learnt in memory.sites.items():
                if learnt.observations:
                    source = memory.kind.at(site).fingerprint
                    sites[site] = KeptSite(now, source, tuple(learnt.observations))
            per = PER_WORK if memory.per_work else PER_SIZE
            live[name] = KeptKind(memory.kind.fingerprint, per, tuple(memory.worked), sites)
        return live | self._kept  # a kind whose covered files are still being read is not recalled yet

    def save_soon(self, kinds: Mapping[str, KeptKind]) -> None:
        """Write the file in a thread."""
        writer = threading.Thread(target=self._write, args=(kinds,), name="memory", daemon=True)
        try:
            writer.start()
        except RuntimeError as error:  # the system has no thread left
            self._warn(str(error))
        else:
            self._writer = writer

    def save_last(self, kinds: Mapping[str, KeptKind]) -> None:
        """Write the file and wait for it, at most WRITE_WAIT_S; called once, at the end."""
        if self._writer is not None:
            self._writer.join(WRITE_WAIT_S)
        if not self._writing():
            self.save_soon(kinds)
            if self._writer is not None:
                self._writer.join(WRITE_WAIT_S)
        if self._writing():
            said = "memory %s: not written within %g s; remedy: use a faster disk"
            log.warning(said, self.path, WRITE_WAIT_S)

    def _writing(self) -> bool:
        return self._writer is not None and self._writer.is_alive()

    def _believed(self, site: KeptSite) -> tuple[Observation, ...]:
        """The newest observations of a site: half as many for each HALF_LIFE_S since they were saved."""
        away_s = max(0.0, self._now() - site.saved_at)  # the clock may have been set back
        count = math.ceil(len(site.observations) * 2 ** (-away_s / HALF_LIFE_S))
        return site.observations[-count:] if count >= WARM_UP else ()

    def _write(self, kinds: Mapping[str, KeptKind]) -> None:
        try:
            replace_file(self.path, memory_file.encode(kinds))
            self._failed = False
        except OSError as error:
            self._warn(error.strerror)

    def _warn(self, why: str | None) -> None:
        """Warn once, until the file can be written again."""
        if not self._failed:
            log.warning("memory %s cannot be written: %s; remedy: use another file", self.path, why)
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
            said = "memory %s: %s; starting cold, %s; remedy: none, the tasks are learnt again"
            log.warning(said, self.path, reason, self._set_aside())
            return {}

    def _set_aside(self) -> str:
        """Rename the first file that could not be read, so that it is kept; returns what happened to it."""
        aside = self.path.with_name(f"{self.path.name}.unreadable")
        if os.path.lexists(aside):
            return f"it will be replaced: {aside} is there already"
        try:
            self.path.rename(aside)
        except OSError as error:
            return f"it will be replaced: it cannot be renamed: {error.strerror}"
        return f"the file is now {aside}"


def _as_learnt(observations: Collection[Observation], saved_per: str, per_work: bool) -> list[Observation]:
    """The observations per size or per work, as the memory learns now; those without work may not fit."""
    if not per_work:
        return [_with_amount(one, one.size) for one in observations]
    if saved_per == PER_WORK:
        return list(observations)
    return [_with_amount(one, one.work) for one in observations if one.work is not None]


def _fits(kept: KeptKind, count: int | None) -> bool:
    """Whether all kept sizes have as many numbers as the sizes of now."""
    sizes = [one.size for site in kept.sites.values() for one in site.observations]
    return count is None or all(count == (len(size) if isinstance(size, tuple) else 1) for size in sizes)


def _with_amount(one: Observation, amount: Size) -> Observation:
    return one if one.amount == amount else replace(one, amount=amount)
