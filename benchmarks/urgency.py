"""Eight streams on one busy worker, with and without saying when their answers are useless.

    python -m benchmarks.urgency [--seconds 60] [--load 0.9] [--demand azure-code] [--seed 1]

Other robots ask for runs of the same length when a recorded demand says so, scaled so that the worker is busy
for this share of the time. Both cases are played on real processes in turn; the recordings are in
`benchmarks/demand`.
"""

import argparse
import contextlib
import re
import statistics
import threading
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from benchmarks.arrivals import USUAL, arrivals
from benchmarks.measure import Requirement, Table
from benchmarks.servers import cloud_server
from offboard import Offloader, task
from offboard.robot_client.execution.call_future import CallFuture

STREAMS, OTHERS = 8, 8
HZ, HORIZON = 30.0, 50
RUN_S = 0.06
CALLS_PER_S = 1.2  # of each stream, which asks as often as it may
FIRST_S = 10.0  # of a stream, which is not counted
WAIT_S = 20.0
LATE_S = 10.0  # the time limit of the others
ROUNDS = 2

Floats = NDArray[np.float64]


def too_slow(observation: float) -> Floats:
    """These robots have no policy that keeps up."""
    time.sleep(10 * HORIZON / HZ)
    return np.full((HORIZON, 1), observation)


@task(
    "policy",
    size=lambda _: 1.0,
    variants={"onboard": too_slow},
    quality={"onboard": 0.5, "cloud": 1.0},
)
def policy(observation: float) -> Floats:
    time.sleep(RUN_S)
    return np.full((HORIZON, 1), observation)


class Others:
    """Robots that are in no hurry."""

    def __init__(self, endpoint: str, times: list[float]) -> None:
        self._robots = [Offloader.connect(endpoint, policy="cloud") for _ in range(OTHERS)]
        self._times, self.over = times, threading.Event()
        for one in self._robots:
            one.wait_for_sites(policy, WAIT_S)
        self._thread = threading.Thread(target=self._run)

    def start(self) -> None:
        self._thread.start()

    def _run(self) -> None:
        began_s, asked = time.monotonic(), []
        for number, at_s in enumerate(self._times):
            if self.over.wait(max(0.0, began_s + at_s - time.monotonic())):
                break
            robot = self._robots[number % OTHERS]
            asked.append(robot.submit(policy, 1.0, where="cloud", timeout_s=LATE_S))

    def close(self) -> None:
        self.over.set()
        self._thread.join()
        for one in self._robots:
            one.close()


def played(endpoint: str, seconds: float) -> list[tuple[int, int, list[float]]]:
    """Of each stream, the steps, those without an action, and the ages of the others in seconds."""

    def robot(number: int) -> tuple[int, int, list[float]]:
        with Offloader.connect(endpoint) as offload:
            offload.wait_for_sites(policy, WAIT_S)
            steps, empty, ages = 0, 0, []
            with offload.stream(policy, hz=HZ, horizon=HORIZON, calls_per_s=CALLS_PER_S) as actions:
                began_s = time.monotonic()
                while (now_s := time.monotonic()) < began_s + FIRST_S + seconds:
                    actions.see(float(number))
                    step = actions.next()
                    if now_s > began_s + FIRST_S:
                        steps += 1
                        empty += step.action is None or step.held
                        if step.age_s is not None:
                            ages.append(step.age_s)
                    time.sleep(max(0.0, 1.0 / HZ - (time.monotonic() - now_s)))
            return steps, empty, ages

    with ThreadPoolExecutor(STREAMS) as pool:
        return list(pool.map(robot, range(STREAMS)))


def case(flags: argparse.Namespace, seed: int, *, urgent: bool) -> tuple[float, float, float]:
    """The share of empty steps, the mean age of actions in ms, and the answers of the others per second."""
    hidden = mock.patch.object(CallFuture, "useful_s", property(lambda _: None, lambda *_: None), create=True)
    with contextlib.ExitStack() as stack:
        if not urgent:
            stack.enter_context(hidden)
        server = stack.enter_context(
            cloud_server("benchmarks.urgency", CLOUD_WORKERS="1", CLOUD_EXECUTOR="threads")
        )
        own = STREAMS * CALLS_PER_S
        seconds = flags.seconds + FIRST_S
        times = arrivals(flags.demand, max(0.0, flags.load / RUN_S - own), seconds, seed)
        others = Others(server.endpoint, times)
        stack.callback(others.close)
        others.start()
        found = played(server.endpoint, flags.seconds)
        metrics = urllib.request.urlopen(f"http://127.0.0.1:{server.http_port}/metrics").read().decode()
    busy_s = sum(map(float, re.findall(r"offboard_server_run_seconds_sum\{[^}]*\} (\S+)", metrics)))
    steps, empty = sum(one[0] for one in found), sum(one[1] for one in found)
    ages = [age for one in found for age in one[2]]
    return 100.0 * empty / steps, 1000.0 * statistics.mean(ages), 100.0 * busy_s / seconds


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.urgency", description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each stream (default: %(default)s)")
    parser.add_argument("--load", type=float, default=0.9, help="of the worker (default: %(default)s)")
    parser.add_argument("--demand", default=USUAL, help="a recording (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the place in it (default: %(default)s)")
    flags = parser.parse_args()
    found: dict[bool, list[tuple[float, float, float]]] = {True: [], False: []}
    for number in range(ROUNDS):
        for urgent in found:
            found[urgent].append(case(flags, flags.seed + number, urgent=urgent))
    mean = {
        urgent: [statistics.mean(column) for column in zip(*rows, strict=True)]
        for urgent, rows in found.items()
    }
    rows = [
        [name, *(f"{one:.2f}" for one in mean[urgent])]
        for urgent, name in ((False, "as they come"), (True, "with urgency"))
    ]
    columns = ["requests", "empty steps, %", "age of actions, ms", "busy, %"]
    ratio = mean[True][0] / max(1e-9, mean[False][0])
    print(Table(f"{STREAMS} streams on a busy worker", columns, rows, [
        Requirement("empty steps, with urgency / without", ratio, 0.5),
    ]))  # fmt: skip


if __name__ == "__main__":
    main()
