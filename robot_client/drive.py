"""The simulated robot at work: ask for a plan, drive it, say how it goes, sum it up."""

import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from random import Random

from common import cpu
from common.maps import GridMap, read_map, resampled
from common.planner import plan_path, warm
from robot_client.config import RobotConfig
from robot_client.offloader import BOTH, Offloader
from robot_client.robot import SimulatedRobot
from robot_client.runner import CLOUD, ONBOARD
from robot_client.trace import Record

PROGRESS_EVERY = 10  # tasks
WAYS = (ONBOARD, CLOUD, BOTH)  # in which `Drive.run_alone` runs each of its plans


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

    def warm(self, offload: Offloader) -> None:
        """Compile the planner and prepare the map on all sites before the first measured task.

        `offload` is not the one of the run, which shall learn and record nothing of this.
        """
        warm()
        cpu.used_s()  # the first call looks for what to read
        offload(plan_path, *self._robot.request(), where=BOTH)

    def run(self) -> None:
        """All plans, and the summary."""
        for number in range(self._config.tasks):
            measured = number < self._config.measure
            plan = self._offload(plan_path, *self._robot.request(), where=BOTH if measured else None)
            self._robot.drive(plan)
            record = self._offload.last
            assert record is not None
            self._summary.add(record, planned=plan.status == "NONE")
            _progress(number + 1, self._config.tasks, record)
        for line in self._summary.lines():
            self._say(line)

    def run_alone(self, offload: Offloader) -> None:
        """`config.alone` further plans, each run in all WAYS one after the other, in turning order.

        `offload` knows onboard and the cloud, and nobody else.
        """
        whole = 0
        for number, order in enumerate(orders(self._config.alone, self._config.seed)):
            request, ran = self._robot.request(), 0
            for n, way in enumerate(order, 1):
                plan = offload(plan_path, *request, where=way)
                record = offload.last
                assert record is not None
                ran += _ran(record, way)
                _progress(number * len(WAYS) + n, self._config.alone * len(WAYS), record)
            self._robot.drive(plan)
            whole += ran == len(WAYS)
        missing = f"; the {CLOUD} did not answer for the others" if whole < self._config.alone else ""
        self._say(
            f"run on each site alone and on both at once: {whole} of {self._config.alone} plans{missing}"
        )


def read_prior(path: Path, resolution: float) -> GridMap:
    """The map that the robot was given; ROS maps at the planning resolution."""
    grid = read_map(path)
    return grid if path.suffix == ".map" else resampled(grid, resolution)


def orders(count: int, seed: int) -> list[tuple[str, ...]]:
    """The order of WAYS for each of so many plans; in every three each way is first, second and third once.

    Whatever a run leaves behind for the next one, warm caches or a spent quota, meets all ways alike.
    """
    random = Random(seed)
    found: list[tuple[str, ...]] = []
    while len(found) < count:
        order = random.sample(WAYS, len(WAYS))
        found += [(*order[n:], *order[:n]) for n in range(len(WAYS))]
    return found[:count]


def describe(record: Record) -> str:
    """One decision in one line."""
    took = ", ".join(
        f"{one.site} {one.seconds * 1e3:.1f} ms" if one.ok else f"{one.site} {one.error}"
        for one in record.executions
    )
    return f"size {record.size:.2f} -> {took} ({record.decision.reason})"


def _ran(record: Record, way: str) -> bool:
    """Whether it ran well where it was sent, and nowhere else."""
    sent = [ONBOARD, CLOUD] if way == BOTH else [way]
    return sorted(one.site for one in record.executions if one.ok) == sorted(sent)


def _progress(done: int, total: int, record: Record) -> None:
    if sys.stdout.isatty():
        print(f"\r\x1b[K{done}/{total} {describe(record)}"[:160], end="", flush=True)
        if done == total:
            print()
    elif done % PROGRESS_EVERY == 0 or done == total:
        print(f"{done}/{total} {describe(record)}", flush=True)


class Summary:
    """What the robot says at the end; keeps a few numbers a task."""

    def __init__(self) -> None:
        self._planned = 0
        self._both: list[tuple[float | None, float | None]] = []  # seconds onboard, and of the fastest other
        self._waited: dict[str, list[float]] = {}  # by the chosen site
        self._fallbacks = 0

    def add(self, record: Record, *, planned: bool) -> None:
        self._planned += planned
        if record.decision.both:
            good = {one.site: one.seconds for one in record.executions if one.ok}
            onboard = good.pop(ONBOARD, None)
            self._both.append((onboard, min(good.values(), default=None)))
        else:
            self._waited.setdefault(record.decision.site, []).append(record.waited_s)
            self._fallbacks += len(record.executions) > 1

    def lines(self) -> list[str]:
        chosen = sum(map(len, self._waited.values()))
        lines = [f"{len(self._both) + chosen} tasks answered; a path was found for {self._planned}"]
        if self._both:
            lines.append(f"run on both sites: {len(self._both)}; {_both_times(self._both)}")
        if chosen:
            lines.append(f"run on the chosen site: {chosen} ({self._shares(chosen)}); {self._times()}")
        return lines

    def _shares(self, chosen: int) -> str:
        return ", ".join(f"{site} {len(self._waited[site]) / chosen:.0%}" for site in sorted(self._waited))

    def _times(self) -> str:
        waited = sorted(1e3 * seconds for times in self._waited.values() for seconds in times)
        p95 = waited[min(len(waited) - 1, int(0.95 * len(waited)))]
        mean = statistics.fmean(waited)
        return f"mean {mean:.1f} ms, P95 {p95:.1f} ms; {self._fallbacks} fell back {ONBOARD}"


def _both_times(times: list[tuple[float | None, float | None]]) -> str:
    pairs = [(onboard, other) for onboard, other in times if onboard is not None and other is not None]
    if not pairs:
        return "no answer from another site"
    onboard_ms, other_ms = (1e3 * statistics.fmean(column) for column in zip(*pairs, strict=True))
    share = sum(onboard > other for onboard, other in pairs) / len(pairs)
    return (
        f"cloud mean {other_ms:.1f} ms, onboard mean {onboard_ms:.1f} ms; the cloud was faster in {share:.0%}"
    )
