"""The contract of every runner, and the values that it returns: how a run went, and how a site is.

Which site runs a task is decided in `policies`.
"""

from dataclasses import dataclass, field, fields
from numbers import Real
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from offboard.common import variants
from offboard.common.errors import ConfigError, OffloadError

if TYPE_CHECKING:  # --help needs only the names of the sites
    from concurrent.futures import Future

    from offboard.common.tasks import Kind, Task

ONBOARD, CLOUD = variants.ONBOARD, variants.CLOUD
TIMEOUT_S = 2.0  # default time that a remote site has for a task
TIMEOUT_MAX_S = 24 * 3600.0


class Packed(NamedTuple):
    """What was made smaller for one run: an argument by its number, or all of them (None) by `pack`.

    how: `pack`, or the library that compressed the argument.
    raw_bytes, bytes: before and after. seconds: what it took; 0 if it was done for another site before.
    """

    argument: int | None
    how: str
    raw_bytes: int
    bytes: int
    seconds: float


class Sending(NamedTuple):
    """About how many bytes a run would send now.

    large: the arguments among them that can be compressed, as pairs of their number and their bytes.
    """

    bytes: int
    large: tuple[tuple[int, int], ...] = ()


NOTHING = Sending(0)


@dataclass(slots=True)
class Execution:
    """One run of a task on one site, measured with the robot's own clock.

    seconds: from publishing the task until its answer was received, or until the task was given up.
    failure: why there is no answer; None if there is one.
    censored: the task was given up, so the true time is longer than `seconds`.
    queue_s, run_s: measured by the server, or by the robot onboard; `network_s` is the rest of `seconds`.
    cpu_s: CPU time of the server (onboard: of the robot) during the run, including other tasks that ran.
    bytes_out, bytes_in: bytes of the messages, without transport headers.
    started: false if the task certainly never ran there.
    packed: what was made smaller before it was sent; `network_s` leaves out the time for it.
    held_up: the run failed while the heartbeats of the site were unanswered or late.
    after_s: when the run began, counted from the first run of its task.
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
    packed: tuple[Packed, ...] = ()
    held_up: bool = False
    after_s: float = 0.0

    def without_value(self) -> "Execution":
        """A copy for the record, without the result, which may be large."""
        return Execution(self.site, self.seconds, None, *_AFTER_VALUE(self))

    @property
    def pack_s(self) -> float:
        """How much of `seconds` the robot took to pack the arguments."""
        return sum([one.seconds for one in self.packed])

    @property
    def ok(self) -> bool:
        return self.failure is None

    @property
    def error(self) -> str | None:
        return None if self.failure is None else f"{type(self.failure).__name__}: {self.failure}"


_AFTER_VALUE = attrgetter(*[one.name for one in fields(Execution)[3:]])  # `replace` takes four times as long


class Condition(NamedTuple):
    """What is measured of a site apart from the times of its tasks: the features of a prediction.

    round_trip_s: of its heartbeats; None if it has none.
    silent: its heartbeats go unanswered.
    queue: tasks that wait there, in the server's last report.
    load: share of the robot's CPU that other programs take, 0 to 1; 0 for a server.
    wait_s: how long until the site can begin, because of the robot's own tasks, or of a link that stalls or
        is silent: as long again as it has been so far.
    capacity: share of one CPU at full clock that a task may use there, above 0 to 1.
    server_load: share of the server's CPU that other programs take, in its last report.
    queue_s: how long a task would wait there, in the server's last report; 0: it does not say.
    """

    round_trip_s: float | None = None
    silent: bool = False
    queue: int = 0
    load: float = 0.0
    wait_s: float = 0.0
    capacity: float = 1.0
    server_load: float = 0.0
    queue_s: float = 0.0


UNMEASURED = Condition()


class Lasting(str):
    """Why a site cannot take a task until somebody changes the robot or the server."""


class Runner(Protocol):
    """Runs tasks on one site. Any thread may call any method."""

    @property
    def site(self) -> str: ...

    def unavailable(self, kind: "Kind") -> str | None:
        """Why a task of this kind cannot be sent now; None if it can. Must not block.

        The reason is a `Lasting` one if it cannot go away by waiting.
        """

    def submit(self, task: "Task", budget_s: float) -> "Future[Execution]":
        """Start the task. The future always gets an Execution, never an exception.

        A remote runner gives the task up after `budget_s` seconds.
        """

    def to_send(self, task: "Task") -> Sending:
        """What a run of this task would send now, before it is packed. Must not block."""

    def cancel(self, task: "Task") -> None:
        """The answer is no longer wanted. If the run can be stopped, its future ends now, censored."""

    def hurry(self) -> None:
        """An answer is late: measure the condition of the site as soon as possible. Must not block."""

    def condition(self) -> Condition:
        """The condition now. Called for every task, and again after a late answer. Must not block."""

    def close(self) -> None:
        """Stop, and give up the tasks in flight. Safe to call twice."""


def checked_timeout(timeout_s: float, name: str = "timeout_s") -> float:
    """The same number as a float; ConfigError unless it is a time that a task may have, in seconds."""
    given: object = timeout_s  # whatever the annotation says
    if isinstance(given, bool) or not (isinstance(given, Real) and 0 < timeout_s <= TIMEOUT_MAX_S):
        raise ConfigError(f"{name} {timeout_s!r}: must be a number above 0, at most {TIMEOUT_MAX_S:g}")
    return float(timeout_s)
