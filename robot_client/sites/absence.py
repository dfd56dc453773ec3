"""Which sites cannot take a task now, why, and how long to wait for them.

Each runner knows this about its own site; `Offloader.wait_for_sites` returns what is found here.
"""

import time
from collections.abc import Mapping

from offboard.common.tasks import Kind
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import Lasting, Runner

POLL_S = 0.01


class Absent(dict[str, str]):
    """Why each absent site cannot take a task, by site. It is empty, and so false, if all sites can."""

    def __str__(self) -> str:
        return "; ".join(f"{site}: {why}" for site, why in self.items()) or "all sites can take this task"

    def __repr__(self) -> str:
        return f"<Absent: {self}>"


def absent_sites(runners: Mapping[str, Runner], kind: Kind) -> Absent:
    """The sites that cannot take this kind now."""
    return Absent({site: why for site, runner in runners.items() if (why := runner.unavailable(kind))})


def wait_for_sites(runners: Mapping[str, Runner], kind: Kind, timeout_s: float) -> Absent:
    """Begin the setup of the kind onboard, and wait until it is made and every site can take the kind.

    A site whose reason is a `Lasting` one is not waited for.
    """
    until_s = time.monotonic() + timeout_s
    setups = {
        site: runner.prepare(kind) for site, runner in runners.items() if isinstance(runner, OnboardRunner)
    }
    while True:
        absent = absent_sites(runners, kind)
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
