"""The simulated robot at work: ask for a plan, drive it, say how it goes, sum it up."""

import statistics
import sys
from collections.abc import Callable
from pathlib import Path

from common.maps import GridMap, read_map, resampled
from common.planner import plan_path, warm
from robot_client.config import RobotConfig
from robot_client.offloader import BOTH, Offloader
from robot_client.robot import SimulatedRobot
from robot_client.runner import ONBOARD
from robot_client.trace import Record

PROGRESS_EVERY = 10  # tasks


class Drive:
    """Makes `config.tasks` plans on `prior`, the first `config.measure` of them on both sites."""

    def __init__(
        self, config: RobotConfig, prior: GridMap, offload: Offloader, say: Callable[[str], None]
    ) -> None:
        self._config = config
        self._offload = offload
        self._say = say
        self._robot = SimulatedRobot(
            prior, seed=config.seed, obstacles=config.obstacles, radius_m=config.radius_m
        )
        self._summary = Summary()

    def warm(self) -> None:
        """Compile the planner and prepare the map before the first measured task."""
        warm()
        plan_path(*self._robot.request())

    def run(self) -> int:
        for number in range(self._config.tasks):
            measured = number < self._config.measure
            plan = self._offload(plan_path, *self._robot.request(), where=BOTH if measured else None)
            self._robot.drive(plan)
            record = self._offload.last
            assert record is not None
            self._summary.add(record, planned=plan.status == "NONE")
            self._progress(number + 1, record)
        for line in self._summary.lines():
            self._say(line)
        return 0

    def _progress(self, done: int, record: Record) -> None:
        if sys.stdout.isatty():
            print(f"\r\x1b[K{done}/{self._config.tasks} {describe(record)}"[:160], end="", flush=True)
            if done == self._config.tasks:
                print()
        elif done % PROGRESS_EVERY == 0 or done == self._config.tasks:
            print(f"{done}/{self._config.tasks} {describe(record)}", flush=True)


def read_prior(path: Path, resolution: float) -> GridMap:
    """The map that the robot was given; ROS maps at the planning resolution."""
    grid = read_map(path)
    return grid if path.suffix == ".map" else resampled(grid, resolution)


def describe(record: Record) -> str:
    """One decision in one line."""
    took = ", ".join(
        f"{one.site} {one.seconds * 1e3:.1f} ms" if one.ok else f"{one.site} {one.error}"
        for one in record.executions
    )
    return f"size {record.size:.2f} -> {took} ({record.decision.reason})"


class Summary:
    """What the robot says at the end."""

    def __init__(self) -> None:
        self._records: list[Record] = []
        self._planned = 0

    def add(self, record: Record, *, planned: bool) -> None:
        self._records.append(record)
        self._planned += planned

    def lines(self) -> list[str]:
        both = [r for r in self._records if r.decision.both]
        chosen = [r for r in self._records if not r.decision.both]
        lines = [f"{len(self._records)} tasks answered; a path was found for {self._planned}"]
        if both:
            lines.append(f"run on both sites: {len(both)}; {_times(both)}")
        if chosen:
            lines.append(_chosen_line(chosen))
        return lines


def _chosen_line(records: list[Record]) -> str:
    waited = sorted(record.waited_s * 1e3 for record in records)
    sites = sorted({record.decision.site for record in records})
    shares = ", ".join(
        f"{site} {sum(r.decision.site == site for r in records) / len(records):.0%}" for site in sites
    )
    fallbacks = sum(len(r.executions) > 1 for r in records)
    p95 = waited[min(len(waited) - 1, int(0.95 * len(waited)))]
    return (
        f"run on the chosen site: {len(records)} ({shares}); mean {statistics.fmean(waited):.1f} ms, "
        f"P95 {p95:.1f} ms; {fallbacks} fell back {ONBOARD}"
    )


def _times(records: list[Record]) -> str:
    by_site: dict[str, list[float]] = {}
    for record in records:
        for one in record.executions:
            if one.ok:
                by_site.setdefault(one.site, []).append(one.seconds * 1e3)
    means = ", ".join(f"{site} mean {statistics.fmean(times):.1f} ms" for site, times in by_site.items())
    faster = sum(1 for r in records if r.used != ONBOARD)
    return f"{means}; onboard was slower in {faster / len(records):.0%}"
