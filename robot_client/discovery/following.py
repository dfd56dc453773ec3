"""The thread that reads a list of servers again and again.

How a list is read is in `sites_file` and `dns_name`; what it changes is in `present_sites`.
"""

import logging
import threading
from typing import Protocol

from offboard.common.errors import OffloadError
from offboard.robot_client.discovery.present_sites import PresentSites
from offboard.robot_client.discovery.roster import Server

TEND_S = 2.0  # the longest pause until the sites connect to new servers and close what has left
SETTLE = 0.2  # of the usual pause: until a list that has just changed is read again

log = logging.getLogger(__name__)


class Source(Protocol):
    """A list of servers. `settling`: it has just changed, and should be read again soon."""

    name: str
    settling: bool

    def read(self) -> list[Server] | None:
        """The servers now; None if nothing is new. OffloadError if the list cannot be used."""


class Following:
    """Reads `source` every `every_s` seconds; a list that cannot be used leaves the last one as it is."""

    def __init__(self, source: Source, sites: PresentSites, every_s: float) -> None:
        self._source = source
        self._sites = sites
        self._every_s = self._left_s = every_s  # `_left_s`: until the list is read again
        self._stop = threading.Event()
        self._warned = self._failed = ""
        self._thread = threading.Thread(target=self._run, name=source.name, daemon=True)
        sites.on_close(self._stop.set)

    def start(self) -> None:
        """Read the list in a thread from now on: a name server may keep it waiting."""
        self._left_s = 0.0
        self._thread.start()

    def read(self) -> None:
        """Read the list once. A problem is logged once, until the list can be used again."""
        try:
            listed = self._source.read()
        except OffloadError as error:
            if str(error) != self._warned:
                self._warned = str(error)
                said = "%s: %s; the last servers stay in use; remedy: correct it, it is read again"
                log.warning(said, self._source.name, error)
            return
        if not self._source.settling:
            self._warned = ""
        if listed is not None:
            self._sites.follow(listed, self._source.name)

    def tend(self, passed_s: float) -> None:
        """This time has passed: read the list if that is due, and let the sites connect and close."""
        self._left_s -= passed_s
        due = self._left_s <= 0
        try:
            if due:
                self.read()
            self._sites.refresh()
        except Exception as error:  # this thread must go on
            if repr(error) != self._failed:
                self._failed = repr(error)
                log.exception("%s: it is read again; remedy: report this traceback", self._source.name)
        if due:
            self._left_s = self._every_s * (SETTLE if self._source.settling else 1.0)

    def _run(self) -> None:
        while not self._stop.wait(pause_s := min(self._left_s, TEND_S)):
            self.tend(pause_s)
