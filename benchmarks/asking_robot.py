"""The robot of `benchmarks.asking`: asks before its calls, or observes; writes what came of each call.

It is started by a testbed, so that its CPU is limited and its link is that of the scenario.
"""

import argparse
import json
import queue
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict
from itertools import chain, count, islice
from pathlib import Path
from random import Random
from typing import Any, TextIO

from benchmarks.application_runs import find_kind
from offboard import DeadlineMissed, Offloader, Record, Settings
from offboard.common.command_line import run_command
from offboard.common.errors import OffloadError
from offboard.common.task_states import TaskStates
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

PROG = "python -m benchmarks.asking_robot"
ASK, OBSERVE = "ask", "observe"
CONNECT_S = 60.0
LATE_S = 60.0  # for which a run that missed its deadline is waited for
DEADLINE_S_MIN = 0.001
BEYOND = 0.25  # of the width of the interval: so far outside of it are the earliest and the latest deadline
BEGIN_S = 0.05  # in which a run that is only measured begins
GUESS = (0.5, 2.0)  # times the expected time, while there is no interval

Call = tuple[Any, ...]


def main() -> int:
    parser = argparse.ArgumentParser(prog=PROG, description=__doc__)
    parser.add_argument("doing", choices=(ASK, OBSERVE))
    for name in ("cloud", "application", "lines"):
        parser.add_argument(f"--{name}", required=True)
    for name in ("seed", "tasks"):
        parser.add_argument(f"--{name}", type=int, required=True)
    parser.add_argument("--timeout", type=float, required=True)
    flags = parser.parse_args()
    kind = find_kind(flags.application)
    module = sys.modules[kind.function.__module__]
    calls = islice(chain.from_iterable(map(module.inputs, count(flags.seed))), flags.tasks)
    play = {ASK: ask, OBSERVE: observe}[flags.doing]
    with Path(flags.lines).open("w", buffering=1) as file:
        play(kind.function, calls, flags.cloud, timeout_s=flags.timeout, seed=flags.seed, file=file)
    return 0


def ask(
    function: Callable[..., Any],
    calls: Iterator[Call],
    cloud: str,
    *,
    timeout_s: float,
    seed: int,
    file: TextIO,
) -> None:
    """Ask what each call should take on each site, then make it there, with a deadline."""
    random, records = Random(seed), queue.SimpleQueue[Record]()
    with Offloader.connect(cloud, timeout_s=timeout_s, observers=[records.put]) as offload:
        _wait(offload, function)
        for number, call in enumerate(calls):
            for site in (ONBOARD, CLOUD) if number % 2 else (CLOUD, ONBOARD):
                line = _asked(offload, function, call, site, random)
                took = [one for one in records.get(timeout=LATE_S).executions if one.site == site]
                line["took_s"] = took[0].seconds if took and took[0].ok else None
                file.write(json.dumps(line) + "\n")


def observe(
    function: Callable[..., Any],
    calls: Iterator[Call],
    cloud: str,
    *,
    timeout_s: float,
    seed: int,
    file: TextIO,
) -> None:
    """Call each task twice: with an offloader that observes, and with one that offloads."""
    with ExitStack() as stack:
        states = TaskStates(workers=1)  # both use the same model

        def connect(**options: Any) -> Offloader:
            settings = Settings(states=states, seed=seed)
            made = Offloader.connect(cloud, timeout_s=timeout_s, settings=settings, **options)
            return stack.enter_context(made)

        observing, sending = connect(observe=True), connect()
        for offload in (observing, sending):
            _wait(offload, function)
        for call in calls:
            observing(function, *call)
            seen = observing.last
            _settle(observing)
            sending(function, *call)
            sent = sending.last
            _settle(sending)
            saved = [one for one in observing.savings().values() if one is not None]
            line = {
                "observed_s": seen.waited_s,
                "sent_s": sent.waited_s,
                "used": sent.used,
                "savings": asdict(saved[0]) if saved else None,
            }
            file.write(json.dumps(line) + "\n")


def _asked(
    offload: Offloader, function: Callable[..., Any], call: Call, site: str, random: Random
) -> dict[str, Any]:
    """What was expected of a call on a site, and whether it met a deadline that was drawn around that."""
    deadline_s = _deadline_s(offload, function, call, site, random)
    expected = offload.expect(function, *call, deadline_s=deadline_s)[site]
    met = True
    try:
        offload(function, *call, where=site, deadline_s=deadline_s)
    except DeadlineMissed:
        met = False
    return {
        "site": site,
        "deadline_s": deadline_s,
        "seconds": expected.seconds,
        "interval": expected.interval,
        "in_time": expected.in_time,
        "met": met,
    }


def _deadline_s(
    offload: Offloader, function: Callable[..., Any], call: Call, site: str, random: Random
) -> float:
    """A deadline that may be met or missed; a long one while nothing is known."""
    expected = offload.expect(function, *call)[site]
    if expected.seconds is None:
        return LATE_S
    low_s, high_s = expected.interval or [times * expected.seconds for times in GUESS]
    beyond_s = BEYOND * (high_s - low_s)
    return max(DEADLINE_S_MIN, random.uniform(low_s - beyond_s, high_s + beyond_s))


def _settle(offload: Offloader) -> None:
    """Wait for the runs that go on after the answer, so that they do not disturb the next call."""
    if offload.last is not None and offload.last.decision.measured is not None:
        time.sleep(BEGIN_S)
    until_s = time.monotonic() + LATE_S
    while any(offload._flights.count(site) for site in (ONBOARD, CLOUD)):
        if time.monotonic() > until_s:
            raise OffloadError(f"a run has not ended after {LATE_S:g} s")
        time.sleep(0.001)


def _wait(offload: Offloader, function: Callable[..., Any]) -> None:
    if absent := offload.wait_for_sites(function, CONNECT_S):
        raise OffloadError(str(absent))


if __name__ == "__main__":
    sys.exit(run_command(PROG, main))
