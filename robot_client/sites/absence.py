"""Which sites can take a task now, why others cannot, and how long to wait for them.

Each runner knows this about its own site; `Offloader.wait_for_sites` returns what is found here.
"""

import logging
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from offboard.common.errors import BadValue, CannotCross, OffloadError, describe
from offboard.common.tasks import Kind, Task
from offboard.common.wire.values import encode
from offboard.robot_client.sites.conversation import Happened
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import Execution, Lasting, Runner

POLL_S = 0.01
PAUSE_AFTER = 3  # calls of a kind in a row whose values could not cross: a rare large value makes no pause
PAUSE_S, PAUSE_MAX_S = 1.0, 60.0  # the first pause, and the longest; each one is twice as long as the last

log = logging.getLogger(__name__)


class Absent(dict[str, str]):
    """Why each absent site cannot take a task, by site. It is empty, and so false, if all sites can."""

    def others_of(self, runners: Mapping[str, Runner]) -> Mapping[str, Runner]:
        """The runners of the sites that can take it."""
        return {site: one for site, one in runners.items() if site not in self} if self else runners

    def __str__(self) -> str:
        return "; ".join(f"{site}: {why}" for site, why in self.items()) or "all sites can take this task"

    def __repr__(self) -> str:
        return f"<Absent: {self}>"


@dataclass(frozen=True, slots=True)
class SiteView:
    """One site at one moment.

    endpoint: of its server; None: it has none, as onboard.
    connected: whether its server can be reached. why_absent: why it takes no task, whatever the kind is.
    in_flight: runs that are under way there.
    story: the last events of its connection and what they led to, the oldest first; times are readings of
        `time.perf_counter`. Empty onboard, and for a runner of your own.
    metadata: what a policy server says about itself.
    """

    endpoint: str | None = None
    connected: bool = True
    why_absent: str | None = None
    in_flight: int = 0
    story: tuple[Happened, ...] = ()
    metadata: Mapping[Any, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        runs = f"{self.in_flight} in flight"
        if self.why_absent is not None:
            return f"{self.why_absent}, {runs}"
        return runs if self.endpoint is None else f"connected to {self.endpoint}, {runs}"


class CrossingPauses:
    """Leaves one site out for a while for kinds whose values cannot cross, so that no call waits in vain."""

    def __init__(self) -> None:
        self._kinds: dict[str, tuple[int, float]] = {}  # the calls in a row, and when the pause ends

    def note(self, kind: str, failure: OffloadError | None, now_s: float) -> None:
        """A call of this kind has ended on the site."""
        if not isinstance(failure, CannotCross):
            self._kinds.pop(kind, None)
            return
        calls = self._kinds.get(kind, (0, 0.0))[0] + 1
        pause_s = 0.0
        if calls >= PAUSE_AFTER:
            pause_s = PAUSE_S * 2.0 ** min(calls - PAUSE_AFTER, PAUSE_MAX_S)
        self._kinds[kind] = calls, now_s + min(pause_s, PAUSE_MAX_S)

    def refuse(self, site: str, kind: str, why: str) -> "Future[Execution]":
        """The run of a call whose arguments cannot cross."""
        failure = CannotCross(why)
        self.note(kind, failure, time.perf_counter())
        future: Future[Execution] = Future()
        future.set_result(Execution(site, 0.0, failure=failure, started=False))
        return future

    def why_absent(self, kind: str) -> str | None:
        if kind not in self._kinds:
            return None
        calls, until_s = self._kinds[kind]
        left_s = until_s - time.perf_counter()
        if left_s <= 0:
            return None
        why = f"the last {calls} calls of {kind} could not be sent, or their answers not be read"
        return f"{why}; next try in {left_s:.0f} s"


def absent_sites(runners: Mapping[str, Runner], kind: Kind) -> Absent:
    """The sites that cannot take this kind now."""
    return Absent({site: why for site, runner in runners.items() if (why := runner.unavailable(kind))})


def wait_for_sites(runners: Mapping[str, Runner], kind: Kind, timeout_s: float, awaited: Absent) -> Absent:
    """Begin the setup of the kind onboard, and wait until it is made and every site can take the kind.

    A site whose reason is a `Lasting` one is not waited for. `awaited`: sites that have no runner yet.
    """
    until_s = time.monotonic() + timeout_s
    setups = {
        site: runner.prepare(kind) for site, runner in runners.items() if isinstance(runner, OnboardRunner)
    }
    while True:
        absent = Absent(awaited | absent_sites(runners, kind))
        waits = [site for site, why in absent.items() if not isinstance(why, Lasting)]
        waits += [site for site, setup in setups.items() if not setup.done()]
        if not waits or time.monotonic() >= until_s:
            break
        time.sleep(POLL_S)
    for site, setup in setups.items():
        if not setup.done():
            absent[site] = f"the setup of task {kind.name} is not over"
        elif (failure := setup.exception()) is not None:
            absent[site] = str(failure)
    return absent


class CrossingCheck:
    """Says once in the log why calls of a kind can only be answered onboard: a value cannot be sent.

    It checks the values of the first call of each kind, even if it runs onboard, and hears of later ones.
    """

    def __init__(self) -> None:
        self._checked: set[str] = set()  # kinds
        self._logged: set[tuple[str, bool]] = set()  # kinds, and whether the task had run

    def check_arguments(self, task: Task) -> None:
        if task.kind.name not in self._checked and task.kind.pack is None:
            self._check(task.kind, list(task.args), ran=False)

    def check_result(self, kind: Kind, value: Any) -> None:
        """Check a result; later calls of this kind are not checked again."""
        if kind.name not in self._checked:
            self._checked.add(kind.name)
            self._check(kind, value, ran=True)

    def hear(self, kind: Kind, executions: Iterable[Execution]) -> None:
        for one in executions:
            if isinstance(one.failure, CannotCross):
                self._log(kind, str(one.failure), ran=one.started)

    def _check(self, kind: Kind, value: Any, *, ran: bool) -> None:
        if kind.policy_server:  # its sites may have another format; `hear` says what they cannot send
            return
        try:
            encode(value, kind.types, name="result" if ran else "arguments")
        except Exception as error:  # noqa: BLE001 - such as a dict that another thread changes meanwhile
            self._log(kind, str(error) if isinstance(error, BadValue) else describe(error), ran=ran)

    def _log(self, kind: Kind, why: str, *, ran: bool) -> None:
        if (kind.name, ran) not in self._logged:
            self._logged.add((kind.name, ran))
            log.warning(
                "%s: only onboard can answer such a call: %s; remedy: change that value", kind.name, why
            )
