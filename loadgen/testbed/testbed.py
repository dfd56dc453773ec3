"""What a scenario is played on: the cloud, the relay and the robots, each a *part* with a name.

`processes` and `containers` fit this contract; what happens to the parts, and when, is the player's business.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

CLOUD, WAN, ROBOT = "cloud", "wan", "robot"
PART = "OFFBOARD_PART"  # in the environment of each part: its name


@dataclass(frozen=True, slots=True)
class Setup:
    """How a part is started: flags of its command by name, and the CPUs that it is held to.

    `command` is the sub-command that the flags belong to: `drive` or `call` of a robot.

    Where it listens, and whom it calls, is the testbed's. A Path among the flags is a file that the testbed
    lets the part see: to write where it is under the run's folder, else to read, with its folder. The output
    of a `shown` part goes where ours does, that of others to logs/NAME.log.
    """

    flags: Mapping[str, Any] = field(default_factory=dict)
    cpus: float | None = None
    shown: bool = False
    command: str = ""


@dataclass(frozen=True, slots=True)
class Usage:
    """What a part holds, its worker processes included: bytes in memory, and open files and sockets."""

    memory_bytes: int
    handles: int


class Testbed(Protocol):
    """A context manager: whatever happens, nothing of it is left when the block is.

    `part` is a name among the setups it was made with: cloud, wan, robot, robot-2, ...
    """

    out: Path

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def start(self, *parts: str) -> None:
        """Start these, or cloud and relay, again if they have ended; cloud and relay are ready on return."""

    def exit_code(self, part: str) -> int | None:
        """Of a part that was started; None while it runs, minus the signal that ended it."""

    def kill(self, part: str) -> None:
        """End it as a crash would: SIGKILL, no chance to say anything."""

    def stop(self, part: str) -> None:
        """Ask it to end, and make it end where it does not within a bounded time."""

    def pause(self, part: str) -> None:
        """Stop it where it is, as a hang would, until `resume`."""

    def resume(self, part: str) -> None: ...

    def set_cpus(self, part: str, cpus: float) -> None:
        """Hold a running part to so many CPUs from now on, also once it is started again."""

    def held(self, part: str) -> str | None:
        """In words, what holds a running part to its CPUs; None where nothing does."""

    def set_hogs(self, part: str, count: int) -> None:
        """So many processes from now on that compete with a running part for its CPUs; they end with it."""

    def set_link(self, **changes: Any) -> dict[str, Any]:
        """Change the link's conditions, as PUT /link of the relay takes them; the whole link on return."""

    def link(self) -> dict[str, Any]:
        """The link as it is, with counts of connections and bytes."""

    def reset(self) -> None:
        """Reset every connection through the relay."""

    def cut(self, part: str) -> None:
        """Cut its network: what is sent to it or by it is lost without a word, until `join`."""

    def join(self, part: str) -> None: ...

    def usage(self, part: str) -> Usage:
        """What a running part holds now."""


Testbed.__test__ = False  # type: ignore[attr-defined]  # not a test, whatever pytest thinks of the name
