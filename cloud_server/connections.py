"""The connections over which robots send requests, and which of them have ended.

libzmq says that a connection has ended, but not whose it was: the kernel is asked instead, through
`tcp_connections`. What becomes of the requests is decided in `scheduler`.
"""

import logging
from dataclasses import dataclass
from typing import Any

from offboard.cloud_server.tcp_connections import end, other_end, silent_s

LOOK_S = 0.5  # between two checks of the connections that wait for answers
# A robot that sends heartbeats is never silent for more than 2.4 s. If nothing of it arrives for 15 s, it
# gives the connection up itself, and no longer waits for the answers.
SILENT_S = 20.0
KEPT = 4096  # connections that are remembered

log = logging.getLogger("offboard.cloud_server")


@dataclass(slots=True)
class _Connection:
    """`file` and `other_end` are known to the kernel. `pings`: its robot sends heartbeats."""

    file: int
    other_end: Any
    pings: bool = False


class Connections:
    """Remembers the connection of each peer. Called under the lock of the channel."""

    def __init__(self) -> None:
        self._known: dict[bytes, _Connection] = {}

    def heard(self, peer: bytes, file: int) -> None:
        """A message of this peer came through this file."""
        known = self._known.get(peer)
        if known is None or known.file != file:
            self._known[peer] = _Connection(file, other_end(file))
            if len(self._known) > KEPT:
                del self._known[next(iter(self._known))]

    def pings(self, peer: bytes) -> None:
        """This peer, which was just heard, sends heartbeats."""
        self._known[peer].pings = True

    def ended(self, peer: bytes) -> bool:
        """Whether the connection has ended. If it was silent for too long, it ends before the next look."""
        known = self._known.get(peer)
        if known is None:
            return False
        if known.other_end is None or other_end(known.file) != known.other_end:
            del self._known[peer]
            return True
        if known.pings and silent_s(known.file, known.other_end) > SILENT_S:
            log.info("closed the connection to %s: nothing came for %g s", known.other_end, SILENT_S)
            end(known.file, known.other_end)
        return False
