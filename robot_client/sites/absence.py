"""Which sites cannot take a task now, why, and how long to wait for them.

Each runner knows this about its own site; `Offloader.wait_for_sites` returns what is found here.
"""

import time
from collections.abc import Mapping

from offboard.common.errors import CannotCross, OffloadError
from offboard.common.tasks import Kind
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import Lasting, Runner

POLL_S = 0.01
PAUSE_AFTER = 3  # calls of a kind in a row whose values could not cross: a rare large value makes no pause
PAUSE_S, PAUSE_MAX_S = 1.0, 60.0  # the first pause, and the longest; each one is twice as long as the last


class Absent(dict[str, str]):
    """Why each absent site cannot take a task, by site. It is empty, and so false, if all sites can."""

    def __str__(self) -> str:
        return "; ".join(f"{site}: {why}" for site, why in self.items()) or "all sites can take this task"

    def __repr__(self) -> str:
        return f"<Absent: {self}>"


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


def present_sites(runners: Mapping[str, Runner], absent: Mapping[str, str]) -> Mapping[str, Runner]:
    """The runners of the sites that are not absent."""
    return {site: one for site, one in runners.items() if site not in absent} if absent else runners


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
