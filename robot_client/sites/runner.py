"""The seam to the outside: a runner runs one task on one site and says how it went."""

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from offboard.common.errors import ConfigError, OffloadError

if TYPE_CHECKING:  # --help needs the names of the sites alone
    from concurrent.futures import Future

    from offboard.common.tasks import Kind, Task

ONBOARD = "onboard"
CLOUD = "cloud"
TIMEOUT_S = 2.0  # that a remote site has for a task, unless told
PORT_MAX = 65_535

_ENDPOINT = re.compile(r"tcp://(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+):(\d{1,5})")


@dataclass(slots=True)
class Execution:
    """One run of a task on one site, measured on the robot's own clock.

    `seconds` is from publishing the task until its answer was received, or until it was given up; then
    `failure` says why, and `censored` that the true time is longer. `queue_s` and `run_s` are the server's
    own; `network_s` is the rest. `cpu_s` is the CPU time that whatever ran it used meanwhile: onboard the
    robot, in the cloud the server, other tasks at the same time included. Bytes are those of the messages,
    without transport headers. `started` is false where the task certainly never ran there.
    """

    site: str
    seconds: float
    value: Any = field(default=None, repr=False)
    failure: OffloadError | None = None
    censored: bool = False
    queue_s: float | None = None
    run_s: float | None = None
    network_s: float | None = None
    cpu_s: float | None = None
    bytes_out: int = 0
    bytes_in: int = 0
    started: bool = True

    def without_value(self) -> "Execution":
        """The same for the record: what a task returned may be large."""
        return Execution(
            self.site,
            self.seconds,
            None,
            self.failure,
            self.censored,
            self.queue_s,
            self.run_s,
            self.network_s,
            self.cpu_s,
            self.bytes_out,
            self.bytes_in,
            self.started,
        )

    @property
    def ok(self) -> bool:
        return self.failure is None

    @property
    def error(self) -> str | None:
        return None if self.failure is None else f"{type(self.failure).__name__}: {self.failure}"


class Condition(NamedTuple):
    """What is measured of a site beside the times of its tasks: the features of a prediction.

    `round_trip_s` is that of its heartbeats (None: it has none); `silent`: they go unanswered; `queue`: tasks
    that wait there, as it last said; `load`: the share of the robot's own CPU that others take, 0 to 1, of a
    server only while it is so large that the server's times tell of it; `wait_s`: how long the robot's own
    tasks, or a link that is held up, will still keep it from beginning; `capacity`: so much of one CPU at
    full clock may a task use there, above 0 to 1; `server_load`: the share of a server's CPU that others
    take. Capacity and load of a server are what it last said.
    """

    round_trip_s: float | None = None
    silent: bool = False
    queue: int = 0
    load: float = 0.0
    wait_s: float = 0.0
    capacity: float = 1.0
    server_load: float = 0.0


UNMEASURED = Condition()


class Runner(Protocol):
    """Runs tasks on one site. All methods may be called from any thread."""

    @property
    def site(self) -> str: ...

    def unavailable(self, kind: "Kind") -> str | None:
        """Why a task of this kind cannot be sent now, or None when it can. Must not block."""

    def submit(self, task: "Task", budget_s: float) -> "Future[Execution]":
        """Start the task. The future always gets an Execution, never an exception; a remote runner
        gives the task up after `budget_s` seconds."""

    def cancel(self, task: "Task") -> None:
        """The answer is no longer wanted: where it can still be stopped, its future ends now, censored."""

    def hurry(self) -> None:
        """An answer is later than expected: find out soon how the site is. Must not block."""

    def condition(self) -> Condition:
        """What is measured now. Must not block; it is asked for every task, and again after a late one."""

    def close(self) -> None:
        """Stop; tasks in flight are given up. Safe to call twice."""


def check_endpoint(where: str, endpoint: str) -> None:
    """ConfigError, naming `where` it stood, unless this is the endpoint of a server."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or not 0 < int(match[2]) <= PORT_MAX:
        raise ConfigError(f"{where}: {endpoint!r} is not tcp://HOST:PORT with a port 1 to {PORT_MAX}")
