"""Says once that robots with another version of Offboard keep tasks onboard, because their hashes differ.

A robot compares hashes by itself, and an old one blames the source of its tasks.
"""

import logging

from offboard.common import VERSION
from offboard.common.source.comparison import other_sources, versions
from offboard.common.tasks import hashes
from offboard.common.wire.messages import Hello

VERSIONS_MAX = 16  # versions that are named; a robot may claim any
NAMES_SHOWN = 5

log = logging.getLogger("offboard.cloud_server")


class OtherVersions:
    """What is known of robots by the version of Offboard in their `hello`."""

    def __init__(self) -> None:
        self._named: set[str] = set()

    def hear(self, hello: Hello) -> None:
        """A robot has said hello."""
        if hello.software in {VERSION, *self._named} or len(self._named) >= VERSIONS_MAX:
            return
        names = other_sources(hashes(), hello.tasks)
        if not names:
            return
        self._named.add(hello.software)
        more = f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
        text = (
            "a robot keeps %s%s onboard: the source differs%s; "
            "remedy: install the same version of Offboard, and of the tasks, on both sides"
        )
        log.warning(text, ", ".join(names[:NAMES_SHOWN]), more, versions(hello.software))
