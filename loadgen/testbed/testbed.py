"""The contract of a testbed, which starts, changes and ends the *parts* of a run: servers, relays, robots.

Each server has a relay of its own: the server `cloud` has `wan`, a server `edge` has `wan-edge`.
`local_testbed` and `docker_testbed` implement it. The player decides what happens to the parts, and when.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

CLOUD, WAN, ROBOT = "cloud", "wan", "robot"
PART = "OFFBOARD_PART"  # environment variable of each part that holds its name


def kind_of(part: str) -> str:
    """`cloud`, `wan` or `robot`: a part that is neither relay nor robot is a server, whatever its name."""
    kind = part.partition("-")[0]
    return kind if kind in (WAN, ROBOT) else CLOUD


def relay_of(server: str) -> str:
    """The name of the relay that leads to a server."""
    return WAN if server == CLOUD else f"{WAN}-{server}"


def servers_among(parts: Iterable[str]) -> tuple[str, ...]:
    return tuple(part for part in parts if kind_of(part) == CLOUD)


def servers_behind(part: str, servers: Iterable[str]) -> tuple[str, ...]:
    """The servers that a cut of this part cuts off: a server or relay its own, a robot all of them."""
    return tuple(server for server in servers if part in (server, relay_of(server)) or kind_of(part) == ROBOT)


@dataclass(frozen=True, slots=True)
class Setup:
    """How a part is started.

    `command` is the sub-command: `drive` or `call` of a robot, else empty.
    `flags` are its flags, by name. The testbed adds the addresses. A Path among the flags is
    made visible to the part: writable if it is in the folder of the run, else read-only, with its whole
    folder.
    `cpus` is the CPU quota; None: no quota.
    `site` is the name of a server's site, if it is not that of the part.
    The output of a `shown` part goes to our own output, the output of other parts to logs/NAME.log.
    """

    flags: Mapping[str, Any] = field(default_factory=dict)
    cpus: float | None = None
    shown: bool = False
    command: str = ""
    site: str = ""


def endpoint_flags(setups: Mapping[str, Setup], endpoints: Mapping[str, str]) -> dict[str, str]:
    """The flags with which a robot finds the servers at these endpoints."""
    further = ",".join(
        f"{setups[server].site or server}={endpoint}"
        for server, endpoint in endpoints.items()
        if server != CLOUD
    )
    return {"cloud": endpoints[CLOUD], **({"site": further} if further else {})}


@dataclass(frozen=True, slots=True)
class Usage:
    """Resident memory, and open files and sockets, of a part and its worker processes."""

    memory_bytes: int
    handles: int


class Testbed(Protocol):
    """A context manager: when the block ends, for whatever reason, nothing of the testbed is left.

    `part` is the name of one of its setups: cloud, wan, wan-edge, robot, robot-2, ...
    """

    out: Path

    def __enter__(self) -> "Testbed": ...

    def __exit__(self, *_: object) -> None: ...

    def start(self, *parts: str) -> None:
        """Start these parts, or all servers and relays; a part that has ended is started again.

        On return, the servers and relays among them are ready.
        """

    def exit_code(self, part: str) -> int | None:
        """The exit code of a part that was started: None while it runs, -signal if a signal ended it."""

    def kill(self, part: str) -> None:
        """End a part by SIGKILL, as a crash would."""

    def stop(self, part: str) -> None:
        """Ask a part to end; kill it if it does not end within a bounded time."""

    def pause(self, part: str) -> None:
        """Freeze a part, as a hang would, until `resume`."""

    def resume(self, part: str) -> None: ...

    def set_cpus(self, part: str, cpus: float) -> None:
        """Change the CPU quota of a running part. The quota stays when the part is started again."""

    def held(self, part: str) -> str | None:
        """A description of the CPU quota of a running part, for people; None: no quota."""

    def set_hogs(self, part: str, count: int) -> None:
        """Set how many busy processes compete with a running part for its CPU quota, until the part ends."""

    def set_link(self, server: str | None = None, **changes: Any) -> dict[str, Any]:
        """Change conditions of the link to a server, or of all links, named as in PUT /link of the relay.

        Returns the whole link; that of the first server if all were changed.
        """

    def begin_recording(self, server: str) -> None:
        """Play the recording of the link to a server from its beginning; until then its first row holds."""

    def link(self, server: str = CLOUD) -> dict[str, Any]:
        """The link to a server as it is now, with its counts of connections and bytes."""

    def reset(self, server: str | None = None) -> None:
        """Reset every connection through the relay of a server, or through all relays."""

    def cut(self, part: str) -> None:
        """Cut the network of a part: what it sends, and what is sent to it, is silently lost until `join`."""

    def join(self, part: str) -> None: ...

    def usage(self, part: str) -> Usage:
        """The memory and handles of a running part."""


Testbed.__test__ = False  # type: ignore[attr-defined]  # keeps pytest from collecting it as a test
